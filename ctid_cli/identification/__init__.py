"""Structure, treatment and warnings of a fit: chosen and tried on the records."""
