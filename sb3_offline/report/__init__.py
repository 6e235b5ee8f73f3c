"""What a grid's CSV file says: tables, figures, and the policies at play. Trains nothing."""
