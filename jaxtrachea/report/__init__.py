"""What a user reads of a fit: report, tables, figures."""
