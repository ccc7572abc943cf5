"""What the numbers of a device map must obey together, whatever the device. Each rule returns what breaks it."""

BYTES = {"u8": 1, "i8": 1, "u16": 2, "i16": 2, "u32": 4, "i32": 4, "f32": 4}
INTEGERS = ("u8", "i8", "u16", "i16", "u32", "i32")
UNSIGNED = ("u16", "u32")  #: of registers that carry bits, codes or counts


def registers_of(kind: str) -> int:
    return BYTES[kind] // 2


def overlap_problems(fields: dict[str, tuple[int, str]]) -> list[str]:
    problems: list[str] = []
    taken: dict[int, str] = {}
    for name, (address, kind) in fields.items():
        for register in range(address, address + registers_of(kind)):
            if (other := taken.setdefault(register, name)) != name:
                problems.append(f"{name}: register {register} is already {other}")
                break
    return problems


def base_problems(fields: dict[str, tuple[int, str]], base: int) -> list[str]:
    return [f"{name}: address {at} is below address_base {base}" for name, (at, _) in fields.items() if at < base]


def range_problems(key: str, bounds: list[float]) -> list[str]:
    return [] if bounds[0] < bounds[1] else [f"{key}.range: {bounds} must rise"]


def type_problems(key: str, kind: str, allowed: tuple[str, ...]) -> list[str]:
    return [] if kind in allowed else [f"{key}.type: {kind}; allowed: {', '.join(allowed)}"]


def bit_problems(key: str, bit: int, kind: str) -> list[str]:
    width = 8 * BYTES[kind]
    return [] if bit < width else [f"{key}.bit: {bit} is not in a {kind}; allowed: 0 to {width - 1}"]


def fit_problems(key: str, kind: str, bounds: list[float], scale: float) -> list[str]:
    """A time that is written must fit its object, whatever of the range is asked for."""
    if kind == "f32":
        return []
    high = 2 ** (8 * BYTES[kind] - (kind[0] == "i")) - 1
    fits = 0 <= bounds[0] and bounds[1] / scale <= high
    allowed = f"0 to {high * scale:g}"
    return [] if fits else [f"{key}.range: {bounds} does not fit a {kind}; allowed: {allowed}"]
