"""What every command stands on: line, configuration, files, pages, processes and their end."""
