"""The family of errors that users see: each states the fact and the mend in one line."""


class TestbedError(Exception):
    """Base of every error of this package that is meant for a person.

    Attributes:
        fact: What is wrong, with the name of the file, field, topic or channel.
        mend: What to do about it.
    """

    __test__ = False  # not a test class, whatever pytest makes of its name

    def __init__(self, fact: str, mend: str) -> None:
        self.fact = " ".join(fact.split())
        self.mend = " ".join(mend.split())
        super().__init__(f"{self.fact}: {self.mend}")


class ConfigurationError(TestbedError):
    """A configuration file or a setting is wrong."""


class CalibrationError(TestbedError):
    """A calibration cannot be applied to these clusters."""


class TrialError(TestbedError):
    """A trial cannot be read, or does not hold what is asked of it."""


class IdentificationError(TestbedError):
    """The contact model cannot be identified from these samples."""
