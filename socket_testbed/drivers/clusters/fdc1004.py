"""TI FDC1004 capacitance converter with four inputs (datasheet SNOSCY5B)."""

from __future__ import annotations

from socket_testbed import clocks
from socket_testbed.drivers.clusters.i2c import INPUTS, Conversion, I2cPort
from socket_testbed.errors import DeviceError

_MSB, _LSB, _CONF_MEAS, _FDC_CONF = 0x00, 0x01, 0x08, 0x0C
_IDENTITY = {0xFE: ("maker", 0x5449), 0xFF: ("device", 0x1004)}
_RESET = 0x8000
_REPEAT_ALL = 0x01F0
_DONE = 0x000F
_TO_CAPDAC = 4  # CHB; the offset needs this setting
_MAX_CAPDAC = 31
_RAILS = (0x7FFFFF, -0x800000)
PER_PICOFARAD = 2**19  # [1/pF]
_CAPDAC_UNIT = 3.125  # [pF]
_CAPDAC_STEP = 8  # 25 pF, so that neighbouring ranges of 30 pF overlap
_MAX_RESET_POLLS = 10
_RESET_POLL_INTERVAL = 1e-3  # [s]


class Fdc1004:
    """The converter in repeat mode: a `CapacitiveChip` with four single-ended inputs.

    Args:
        port: Access to the chip's registers.
        sample_rate: Conversions of the chip in a second, shared by its four inputs; one of
            `sample_rates` [1/s].

    Attributes:
        name: Type of the chip, for messages.
        address: Its fixed address on the bus, 0x50.
        sample_rates: Possible values of `sample_rate` [1/s].
        where: Where it is wired, for messages, such as "0x50 behind channel 2 of 0x70 on i2c-1".
        capdac: Offset of each input in steps of 3.125 pF, 0 to 31, by input, shape (4,) [1]; it is
            kept across resets.
    """

    name = "FDC1004"
    address = 0x50
    sample_rates: tuple[int, ...] = (100, 200, 400)

    def __init__(self, port: I2cPort, sample_rate: int) -> None:
        self._port = port
        self._conf = self.sample_rates.index(sample_rate) + 1 << 10 | _REPEAT_ALL
        self.where = port.where
        self.capdac = [0] * INPUTS

    def check_identity(self) -> None:
        """Check that this is an FDC1004, by its registers of maker and device.

        Raises:
            DeviceError: Another chip answers at its address.
        """
        for register, (what, expected) in _IDENTITY.items():
            value = self._port.read(register)
            if value != expected:
                raise DeviceError(
                    f"{self.where} says {what} 0x{value:04X}, not 0x{expected:04X}",
                    "check the address and the wiring, this is not an FDC1004",
                )

    def reset_and_configure(self) -> None:
        """Reset the chip, check its identity, and start converting all inputs in turn.

        Raises:
            DeviceError: The chip does not leave its reset within about 10 ms, or a register does
                not hold what was written to it.
        """
        self._port.write(_FDC_CONF, _RESET)
        for _ in range(_MAX_RESET_POLLS):
            clocks.sleep(_RESET_POLL_INTERVAL)
            if not self._port.read(_FDC_CONF) & _RESET:
                break
        else:
            raise DeviceError(f"{self.where} does not leave its reset", "check its supply")
        self.check_identity()
        wanted = {_CONF_MEAS + n: self._conf_meas(n) for n in range(INPUTS)}
        wanted[_FDC_CONF] = self._conf
        for register, value in wanted.items():
            self._port.write(register, value)
        for register, value in wanted.items():
            kept = self._port.read(register) & ~(_DONE if register == _FDC_CONF else 0)
            if kept != value:
                raise DeviceError(
                    f"{self.where} holds 0x{kept:04X} in register 0x{register:02X} where"
                    f" 0x{value:04X} was written",
                    "check the bus's wiring and its pull-ups",
                )

    def done(self) -> tuple[bool, ...]:
        """Whether each input has a conversion that was not read, shape (4,).

        Raises:
            DeviceError: The chip has lost its settings, as after a failed supply: configure it
                again.
        """
        value = self._port.read(_FDC_CONF)
        if value & ~_DONE != self._conf:
            raise DeviceError(
                f"{self.where} fell back to its reset state (FDC_CONF 0x{value:04X}, not"
                f" 0x{self._conf:04X})",
                "it is configured again; check its supply",
            )
        return tuple(bool(value & 8 >> n) for n in range(INPUTS))

    def read(self, channel: int) -> int:
        """Last conversion of an input, 0..3, a signed code of 24 bits [1]; clears its DONE."""
        # The first one latches the second one, so that both belong to one conversion.
        high, low = self._port.read_in_a_row(2 * channel + _MSB, 2 * channel + _LSB)
        code = high << 8 | low >> 8
        return code - (1 << 24) if code & 0x800000 else code

    def convert(self, channel: int, code: int) -> Conversion:
        """C = code / 2^19 + 3.125 CAPDAC [pF]; a code at a rail shifts CAPDAC towards it.

        Args:
            channel: The input, 0..3.
            code: What `read` returned for it, a signed code of 24 bits [1].
        """
        previous = self.capdac[channel]
        if code not in _RAILS:
            return Conversion(code / PER_PICOFARAD + _CAPDAC_UNIT * previous)
        step = _CAPDAC_STEP if code > 0 else -_CAPDAC_STEP
        self.capdac[channel] = capdac = min(max(previous + step, 0), _MAX_CAPDAC)
        if capdac == previous:
            return Conversion(
                float("nan"),
                fault=f"input {channel + 1} is out of range at {self.where}, CAPDAC {capdac}:"
                " check its sensor for a short or a broken wire",
            )
        self._port.write(_CONF_MEAS + channel, self._conf_meas(channel))
        return Conversion(float("nan"), shifted=True)

    def _conf_meas(self, channel: int) -> int:
        return channel << 13 | _TO_CAPDAC << 10 | self.capdac[channel] << 5
