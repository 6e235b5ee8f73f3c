"""Programs that make, convert and look into datasets."""
