"""The least output error over a stated set of models."""
