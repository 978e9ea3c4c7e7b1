"""The files of a fit: rows of its tables, results.h5 written and read back."""
