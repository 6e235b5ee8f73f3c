"""Look into datasets: statistics, warnings, and a page for the browser."""
