"""Object dictionaries of the nodes that have no electronic data sheet, built in code.

Their communication profile is that of the drives' data sheet; what is theirs alone is added to it.
"""

from collections.abc import Sequence

from canopen import objectdictionary as od
from canopen.objectdictionary import datatypes
from canopen.objectdictionary.eds import import_eds

from sim_plant.faces.canopen_pdo import NO_RTR, SYNCHRONOUS, Key
from sim_plant.faces.canopen_sdo import EDS_PATH

_FIRST_PDO_OBJECT = 0x1400
_TYPES = {
    "b": datatypes.INTEGER8,
    "B": datatypes.UNSIGNED8,
    "h": datatypes.INTEGER16,
    "H": datatypes.UNSIGNED16,
    "i": datatypes.INTEGER32,
    "I": datatypes.UNSIGNED32,
    "f": datatypes.REAL32,
}


def communication_profile(name: str, device_type: int, product: int) -> od.ObjectDictionary:
    """Everything below 1400h as the drives have it, with an identity of its own. As of node 0, as the drives'."""
    dictionary = import_eds(str(EDS_PATH), 0)
    for index in [index for index in dictionary.indices if index >= _FIRST_PDO_OBJECT]:
        del dictionary[index]
    for (index, subindex), value in {(0x1000, 0): device_type, (0x1008, 0): name, (0x1018, 2): product}.items():
        entry = dictionary[index]
        (entry if isinstance(entry, od.ODVariable) else entry[subindex]).default = value
    return dictionary


def add_object(
    dictionary: od.ObjectDictionary, index: int, name: str, type_character: str, access: str = "ro", default: int = 0
) -> None:
    """A number at sub-index 0. `type_character` is that of struct."""
    dictionary.add_object(_variable(index, 0, name, type_character, access, default))


def add_members(dictionary: od.ObjectDictionary, index: int, name: str, type_characters: str) -> None:
    """A record of read-only numbers at sub-indices 1, 2, ..., and their number at 0."""
    record = od.ODRecord(name, index)
    record.add_member(_variable(index, 0, f"{name}, highest sub-index", "B", "const", len(type_characters)))
    for k, character in enumerate(type_characters, start=1):
        record.add_member(_variable(index, k, f"{name} {k}", character, "ro", 0))
    dictionary.add_object(record)


def add_fixed_pdo(
    dictionary: od.ObjectDictionary, communication: int, cob_id: int, objects: Sequence[tuple[Key, int]]
) -> None:
    """A PDO that can be put on and off, and no more. `cob_id` is that of node 0; `objects` with lengths in bits.

    Its mapping stands 200h behind its communication parameters, as CiA 301 has it.
    """
    record = od.ODRecord(f"PDO communication {communication:04X}", communication)
    record.add_member(_variable(communication, 0, "Highest sub-index", "B", "const", 2))
    switch = _variable(communication, 1, "COB-ID", "I", "rw", cob_id)
    switch.relative = True
    record.add_member(switch)
    record.add_member(_variable(communication, 2, "Transmission type", "B", "ro", SYNCHRONOUS))
    dictionary.add_object(record)
    mapping = communication + 0x200
    record = od.ODRecord(f"PDO mapping {mapping:04X}", mapping)
    record.add_member(_variable(mapping, 0, "Number of mapped objects", "B", "ro", len(objects)))
    for k, ((index, subindex), bits) in enumerate(objects, start=1):
        entry = index << 16 | subindex << 8 | bits
        record.add_member(_variable(mapping, k, f"Mapped object {k}", "I", "ro", entry))
    dictionary.add_object(record)


def transmit_cob_id(base: int) -> int:
    """The default of a TPDO, as of node 0: no remote request on it."""
    return NO_RTR | base


def _variable(index: int, subindex: int, name: str, type_character: str, access: str, default: int) -> od.ODVariable:
    variable = od.ODVariable(name, index, subindex)
    variable.data_type = _TYPES[type_character]
    variable.access_type = access
    variable.default = default
    return variable
