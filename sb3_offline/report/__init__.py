"""Report on the CSV file of a grid: tables, figures, and episodes of the final policies. It trains nothing."""
