"""Tables, exports and texts made from stored results."""
