"""Records, held signals, excitations, sums of sinusoids, sampling schemes and noise."""
