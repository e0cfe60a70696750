"""The load cell: six bridges on a converter on SPI."""
