"""Independent jobs on several cores or machines. This package knows neither learners nor data."""
