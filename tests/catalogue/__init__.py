"""Datasheets and the catalogue of motors."""
