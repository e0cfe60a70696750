"""The clusters: converters of capacitance behind a multiplexer, on I2C."""
