"""Reproduced studies: specifications, claims, figures, and publication."""
