"""Figures of published studies, computed from their specifications: one module per study, found by name."""
