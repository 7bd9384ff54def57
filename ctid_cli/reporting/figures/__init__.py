"""Figures of experiments: box plots, and measures over the settings that vary."""
