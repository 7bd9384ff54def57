"""Estimates on disk: journal, exported file, manifest and their readers."""
