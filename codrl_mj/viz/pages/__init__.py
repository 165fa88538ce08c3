"""Pages as self-contained HTML files: reports, certificates, motors, identifications."""
