"""What experiments share: run folders."""
