"""The sections of a report: each module has the data, the figures and the text of one."""
