"""The load cell: six bridges into a converter on SPI."""
