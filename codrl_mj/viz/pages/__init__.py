"""Pages: a run's report, the certificate, a motor, what identification found; each one HTML file, alone."""
