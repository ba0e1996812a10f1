"""What machines were told and what they did, as files: recordings and logs of runs."""
