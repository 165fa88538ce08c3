"""Files that trainings leave: whole files, run folders and what they came to, policies that are safe to load."""
