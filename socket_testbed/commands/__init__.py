"""Verbs of the command line: functions whose signatures define the options."""
