"""Success labels from examples of success: which observations show the solved task, and which episodes solve it."""
