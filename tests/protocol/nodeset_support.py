"""Small node sets in the form that the published ones have, for tests: the names and numbers that the server looks for,
and one thing of each kind that it must not take over as it stands.
"""

from pathlib import Path

DI = "http://opcfoundation.org/UA/DI/"
MACHINERY = "http://opcfoundation.org/UA/Machinery/"
PADIM = "http://opcfoundation.org/UA/PADIM/"
PROCESS_VALUES = "http://opcfoundation.org/UA/Machinery/ProcessValues/"
DATE = "2024-01-01T00:00:00Z"
ALIASES = {
    "Boolean": 1, "Double": 11, "String": 12, "LocalizedText": 21, "Number": 26, "Organizes": 35,
    "HasModellingRule": 37, "HasTypeDefinition": 40, "HasSubtype": 45, "HasProperty": 46, "HasComponent": 47,
    "Range": 884, "EUInformation": 887, "HasInterface": 17603,
}  # fmt: skip
MANDATORY, OPTIONAL = "i=78", "i=80"
TYPE, INTERFACE, PROPERTY, UNIT_TYPE, UNIT_RANGE_TYPE = "i=58", "i=17602", "i=68", "i=17497", "i=17570"


def node_set(uri: str, nodes: str, requires: dict[str, str] | None = None, date: str = DATE) -> str:
    """The text of a file. Its own namespace is 1, those that it requires follow."""
    requires = requires or {}
    uris = "".join(f"<Uri>{one}</Uri>" for one in (uri, *requires))
    models = "".join(
        f'<RequiredModel ModelUri="{one}" Version="1.0" PublicationDate="{of}"/>' for one, of in requires.items()
    )
    aliases = "".join(f'<Alias Alias="{name}">i={number}</Alias>' for name, number in ALIASES.items())
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n<UANodeSet xmlns="http://opcfoundation.org/UA/2011/03/UANodeSet.xsd">'
        f'<NamespaceUris>{uris}</NamespaceUris><Models><Model ModelUri="{uri}" Version="1.0" PublicationDate="{date}">'
        f"{models}</Model></Models><Aliases>{aliases}</Aliases>{nodes}</UANodeSet>"
    )


def node(
    kind: str, number: int, name: str, above: tuple[str, str], rule: str = "", of: str = "", more: str = "", **also: str
) -> str:
    """One node below `above`: the name of the reference, and a node id. `of`: its type."""
    attributes = "".join(f' {key}="{value}"' for key, value in also.items())
    references = f'<Reference ReferenceType="{above[0]}" IsForward="false">{above[1]}</Reference>{more}'
    references += f'<Reference ReferenceType="HasModellingRule">{rule}</Reference>' if rule else ""
    references += f'<Reference ReferenceType="HasTypeDefinition">{of}</Reference>' if of else ""
    parent = "" if above[0] in ("HasSubtype", "Organizes") else f' ParentNodeId="{above[1]}"'
    plain = name.partition(":")[2] or name
    return (
        f'<{kind} NodeId="ns=1;i={number}" BrowseName="{name}"{parent}{attributes}>'
        f"<DisplayName>{plain}</DisplayName><References>{references}</References></{kind}>"
    )


def has(number: int, name: str, above: int, rule: str, kind: str = "String") -> str:
    """A property; AccessLevel 3: the file says that it can be written."""
    return node("UAVariable", number, name, ("HasProperty", f"ns=1;i={above}"), rule, PROPERTY, DataType=kind,
                AccessLevel="3", UserAccessLevel="3")  # fmt: skip


DI_NODES = node("UAObjectType", 1001, "1:TopologyElementType", ("HasSubtype", TYPE)) + node(
    "UAMethod", 7001, "1:Lock", ("HasComponent", "ns=1;i=1001"), OPTIONAL
)
MACHINERY_NODES = (
    node("UAObject", 1001, "1:Machines", ("Organizes", "i=85"), of="i=61")
    + node("UAObjectType", 1003, "1:INameplateType", ("HasSubtype", INTERFACE))
    + has(6001, "2:Manufacturer", 1003, MANDATORY, "LocalizedText")
    + has(6002, "2:SerialNumber", 1003, MANDATORY)
    + has(6003, "1:YearOfConstruction", 1003, OPTIONAL)
    + node("UAObjectType", 1004, "1:ItemIdentificationType", ("HasSubtype", "ns=2;i=1001"),
           more='<Reference ReferenceType="HasInterface">ns=1;i=1003</Reference>')
    + has(6004, "2:ComponentName", 1004, OPTIONAL, "LocalizedText")
    + node("UAMethod", 7002, "1:Identify", ("HasComponent", "ns=1;i=1004"), MANDATORY)
    + node("UAObjectType", 1012, "1:MachineIdentificationType", ("HasSubtype", "ns=1;i=1004"))
    + has(6005, "1:Location", 1012, OPTIONAL)
    + has(6006, "2:ProductInstanceUri", 1012, MANDATORY)
    + has(6007, "DefaultInstanceBrowseName", 1012, "")
)  # fmt: skip
PADIM_NODES = (
    node("UAObjectType", 1022, "1:AnalogSignalType", ("HasSubtype", TYPE))
    + has(1035, "1:SignalTag", 1022, MANDATORY)
    + node("UAVariable", 1027, "1:AnalogSignal", ("HasComponent", "ns=1;i=1022"), MANDATORY, UNIT_RANGE_TYPE,
           DataType="Number", ValueRank="-2", AccessLevel="3")
)  # fmt: skip


def _limit(number: int, name: str) -> str:
    return node("UAVariable", number, name, ("HasComponent", "ns=1;i=6033"), OPTIONAL, UNIT_TYPE, DataType="Number",
                AccessLevel="3") + has(number + 1, "EngineeringUnits", number, MANDATORY, "EUInformation")  # fmt: skip


PROCESS_VALUES_NODES = (
    node("UAObjectType", 1003, "1:ProcessValueType", ("HasSubtype", "ns=2;i=1022"))
    + node("UAVariable", 6033, "2:AnalogSignal", ("HasComponent", "ns=1;i=1003"), MANDATORY, UNIT_RANGE_TYPE,
           DataType="Number", ValueRank="-2", AccessLevel="3")
    + has(6034, "EngineeringUnits", 6033, MANDATORY, "EUInformation") + has(6035, "EURange", 6033, MANDATORY, "Range")
    + _limit(6115, "1:LowLimit") + _limit(6117, "1:HighLimit") + _limit(6119, "1:HighHighLimit")
    + node("UAVariable", 6036, "1:ProcessValueSetpoint", ("HasComponent", "ns=1;i=1003"), OPTIONAL, UNIT_RANGE_TYPE,
           DataType="Number", ValueRank="-2", AccessLevel="3")
    + has(6037, "EngineeringUnits", 6036, MANDATORY, "EUInformation") + has(6038, "EURange", 6036, MANDATORY, "Range")
    + node("UAMethod", 7001, "2:ZeroPointAdjustment", ("HasComponent", "ns=1;i=1003"), MANDATORY)
)  # fmt: skip

#: Texts by model. Names of files say nothing, and their order is not that in which they need each other.
SMALL = {
    DI: node_set(DI, DI_NODES),
    MACHINERY: node_set(MACHINERY, MACHINERY_NODES, {DI: DATE}),
    PADIM: node_set(PADIM, PADIM_NODES, {DI: DATE}),
    PROCESS_VALUES: node_set(PROCESS_VALUES, PROCESS_VALUES_NODES, {PADIM: DATE}),
}


def write(folder: Path, texts: dict[str, str] = SMALL) -> str:
    """The folder's path. Last needed first."""
    folder.mkdir(exist_ok=True)
    for number, text in enumerate(reversed(texts.values())):
        (folder / f"{number}.xml").write_text(text, encoding="utf-8")
    return str(folder)
