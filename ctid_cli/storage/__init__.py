"""Estimates on disk: journal, sealed file, manifest and their readers."""
