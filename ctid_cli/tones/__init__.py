"""Number, frequencies and amplitudes of the tones of recorded signals over time, with standard errors."""
