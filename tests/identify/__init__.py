"""Identification of motors from bench logs."""
