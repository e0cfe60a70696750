"""The clusters: FDC1004 converters of capacitance on I2C, behind a multiplexer or not."""
