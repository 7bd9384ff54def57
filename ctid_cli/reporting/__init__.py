"""Tables, exports and texts of stored results."""
