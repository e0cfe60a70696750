"""The report on a trial: one page with the paper's results, its figures and their data."""
