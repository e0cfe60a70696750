"""Results of a trial: one class each, with its tables, its document and its figure.

The functions of the API make them, pages and reports show them.
"""
