"""What is said of a sweep: rows, statistics, tables, figures, conclusions."""
