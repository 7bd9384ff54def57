"""Pages in HTML that open anywhere: one file each, without scripts and without anything that must be fetched."""
