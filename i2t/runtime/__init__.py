"""How programs run: batches, compiling, the folder of compiled programs, progress."""
