"""Test recordings of machines that are independent of the analysis, and what it makes of them."""
