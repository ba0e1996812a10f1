"""What every command stands on: its line, configuration, files and pages, processes and how they end."""
