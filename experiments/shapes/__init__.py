"""Which of five stamps was pressed into the skin."""
