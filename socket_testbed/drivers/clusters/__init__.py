"""The clusters: FDC1004 capacitance converters on I2C, with or without a multiplexer."""
