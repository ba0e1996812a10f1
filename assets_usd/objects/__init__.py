"""Objects: procedural families, mesh import, USD writing and reading, contact sheets."""
