"""Files of others: read within stated bounds of size, memory and time, or refused in one line."""
