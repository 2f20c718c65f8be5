"""Active touch as an environment: touches are chosen one by one, and something is to be found out."""
