"""Tones of recorded signals over time: how many there are, and what is known of each at every instant."""
