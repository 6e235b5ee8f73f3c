"""Datasets on disk, the buffer that learns from them, and success examples. This room knows no algorithm."""
