"""The cells of the table of extremes, one module for each topic."""
