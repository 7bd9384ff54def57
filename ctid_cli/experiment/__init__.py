"""Experiments: from a specification to stored and summarised estimates."""
