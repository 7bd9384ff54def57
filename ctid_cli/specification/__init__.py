"""Reading and checking of specifications in YAML."""
