"""Pages in a browser; `make browser` runs these."""
