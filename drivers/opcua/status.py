"""OPC UA StatusCodes in words (OPC 10000-4, 7.39; numbers of OPC 10000-6, annex A). No I/O."""

BAD_TYPE_MISMATCH = 0x80740000
BAD_TRANSACTION_FAILED = 0x80F10000  #: nothing is wrong with this one, but another of the request was refused

_NAMES = {
    0x80010000: "BadUnexpectedError",
    0x80020000: "BadInternalError",
    0x80030000: "BadOutOfMemory",
    0x80050000: "BadCommunicationError",
    0x800A0000: "BadTimeout",
    0x80100000: "BadTooManyOperations",
    0x801F0000: "BadUserAccessDenied",
    0x80310000: "BadNoCommunication",
    0x80320000: "BadWaitingForInitialData",
    0x80330000: "BadNodeIdInvalid",
    0x80340000: "BadNodeIdUnknown",
    0x80350000: "BadAttributeIdInvalid",
    0x803A0000: "BadNotReadable",
    0x803B0000: "BadNotWritable",
    0x803C0000: "BadOutOfRange",
    0x803D0000: "BadNotSupported",
    0x80730000: "BadWriteNotSupported",
    BAD_TYPE_MISMATCH: "BadTypeMismatch",
    0x80890000: "BadConfigurationError",
    0x808A0000: "BadNotConnected",
    0x808B0000: "BadDeviceFailure",
    0x808C0000: "BadSensorFailure",
    0x808D0000: "BadOutOfService",
    0x80AF0000: "BadInvalidState",
    BAD_TRANSACTION_FAILED: "BadTransactionFailed",
    0x40900000: "UncertainLastUsableValue",
    0x40910000: "UncertainSubstituteValue",
    0x40920000: "UncertainInitialValue",
    0x40930000: "UncertainSensorNotAccurate",
    0x40940000: "UncertainEngineeringUnitsExceeded",
    0x40950000: "UncertainSubNormal",
}
_SEVERITIES = ("Good", "Uncertain", "Bad", "Bad")


def is_good(status: int) -> bool:
    """Whether a value with this StatusCode may be used; an uncertain one may not."""
    return status >> 30 == 0


def describe(status: int) -> str:
    """The name of a StatusCode, or its severity and number."""
    code = status & 0xFFFF0000  # the rest are flags
    return _NAMES.get(code) or f"{_SEVERITIES[status >> 30 & 3]} (status {status:08X}h)"
