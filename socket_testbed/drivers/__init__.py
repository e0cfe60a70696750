"""The drivers, a folder per instrument, unchanged with a simulated bus behind them.

A chip has a file of its own name (`clusters/fdc1004.py`, `load_cell/ads131m0x.py`,
`natnet/messages.py` for a protocol): its registers and frames, every answer checked, a
`DeviceError` with a hint for whatever is wrong. It is given its bus: the protocol of the bus is
beside it (`I2cBus`, `SpiDevice`, `Lines`), so that a simulated chip fits behind.

The converter of the clusters can be another chip: `clusters/chip.py` has its protocol.
`simulation/devices/` has the other side of each bus under the same names.

A reader beside it (`clusters/reader.py`, `load_cell/load_cell.py`, `natnet/client.py`) decides
when to read, starts again after a failure, and gives the values for a trigger and the instrument's
health. It never raises for a fault of the hardware.
"""
