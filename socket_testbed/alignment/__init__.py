"""Measurements of sources that know no trigger, brought to triggers, live and offline by one code.

- `series` holds what a source measured, with its own times, whether it came from a topic, a foreign
  bag or a table;
- `align` brings it to triggers, which `triggers` makes of a rate;
- `delay` finds how far a source's stamps lag behind the load, `source_clock` and `common_clock`
  bring clocks together, `events` finds a tap that two sources saw;
- `tables`, `table_file`, `units` and `takes` read the tables and takes of others as series.
"""
