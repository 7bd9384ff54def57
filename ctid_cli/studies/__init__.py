"""Reproduced studies: what belongs to each, its claims, its figures, and what is published of it."""
