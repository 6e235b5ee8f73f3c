"""Datasets on disk, the replay buffer over them, and success examples. This package knows no algorithm."""
