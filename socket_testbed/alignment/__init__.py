"""Measurements of sources that know no trigger, brought to triggers.

`series.py` holds what a source measured, with its own times; it does not matter whether the values
came from a topic, a foreign bag or a table.
"""
