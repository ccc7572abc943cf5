"""OPC UA StatusCodes: which of them are a success, and in words (OPC 10000-4, 7.39; numbers of OPC 10000-6, annex A).

No I/O.
"""

BAD_TYPE_MISMATCH = 0x80740000
BAD_TRANSACTION_FAILED = 0x80F10000  #: nothing is wrong with this one, but another of the request was refused

# The lower half of a StatusCode (OPC 10000-4, 7.39.1). Of what stands beside a value (info type "DataValue"), overflow
# belongs to the queue of a subscription and the historian bits to a history read: of a Read they say nothing. Limit
# bits say that the value is not what was measured, structure and semantics that the map may be wrong.
_INFO_OF_VALUE = 0x0400
_SAYS_NOTHING = 0x0080 | 0x001F
_LIMITS = ("", "at its low limit", "at its high limit", "constant")

_NAMES = {
    0x002E0000: "GoodCompletesAsynchronously",
    0x002F0000: "GoodOverload",
    0x00300000: "GoodClamped",
    0x00960000: "GoodLocalOverride",
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
    """Whether a value with this StatusCode is what was measured: Good and nothing else, without limit bits."""
    return status == 0 or status & ~_SAYS_NOTHING == _INFO_OF_VALUE


def is_done(status: int) -> bool:
    """Whether a write has been done as it was asked: not clamped, not put off."""
    return status == 0


def describe(status: int) -> str:
    """The name of a StatusCode, or its severity and number, and the limit that its value is at."""
    code = status & 0xFFFF0000  # the rest are flags
    name = _NAMES.get(code) or f"{_SEVERITIES[status >> 30 & 3]} (status {status:08X}h)"
    limit = _LIMITS[status >> 8 & 3] if status & 0x0C00 == _INFO_OF_VALUE else ""
    return f"{name}, {limit}" if limit else name
