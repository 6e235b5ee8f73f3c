"""Make new files from a dataset: success examples, or the same episodes with images drawn again."""
