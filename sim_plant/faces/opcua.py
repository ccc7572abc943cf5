"""The OPC UA face: the devices of docs/devices/r2r-opcua.md behind one server."""

import asyncio
import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from asyncua import ua as asyncua_ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.address_space import AddressSpace, AttributeService, NodeManagementService

from sim_plant.devices.amplifier import Amplifier
from sim_plant.devices.drive import Drive
from sim_plant.devices.line_plc import LinePlc
from sim_plant.faces.opcua_codec import (
    MAX_NODES,
    VALUE,
    ReadPlan,
    WrittenValue,
    encode_read,
    encode_write,
    parse_write,
    plan_read,
)
from sim_plant.faces.opcua_nodes import Device, Scalar, Status, Variable, devices_of, write
from sim_plant.faces.opcua_stack import Stack, prepare

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

NAMESPACE = "urn:r2rgate:devices"

_INDEX = 2  #: of the namespace: 0 is the standard's, 1 the server's own
_SAMPLING_S = 0.05  #: of monitored items
_PLANS = 32
_SERVER = User(role=UserRole.Admin)
_EPOCH_TICKS = 116_444_736_000_000_000  #: 1970 in 100 ns since 1601
_READ_ONLY, _READ_WRITE = 1, 3  #: access levels

# What asyncua has to say of its clients is counted here; a terminal is no place for it.
_SILENT = logging.CRITICAL + 1


class OpcUaFace:
    """Serves the axes, the amplifier with its load cells and the PLC that are given; numbers count from 1.

    `clock` gives the time that the devices live in, seconds. The drives listen from now on. The first face of a
    process takes about a second to make. Raises ValueError for a cell that the amplifier does not have.
    """

    def __init__(
        self,
        axes: Mapping[int, Drive],
        amplifier: Amplifier | None,
        cells: Sequence[int],
        plc: LinePlc | None,
        clock: Callable[[], float],
    ) -> None:
        self.clock = clock
        self.requests = 0
        self.malformed = 0  #: requests that could not be decoded, and connections closed because of what came in
        self.devices = devices_of(axes, amplifier, cells, plc)
        self.variables = {v.node_name: v for device in self.devices for v in device.variables()}
        self._plans: dict[bytes, ReadPlan] = {}
        self._stack: Stack | None = None
        self._sampler: asyncio.Task[None] | None = None
        prepare()

    async def open(self, host: str, port: int) -> int:
        """Listen on `host`; port 0 takes a free one. Returns the port. Raises OSError when it is taken."""
        logging.getLogger("asyncua").setLevel(_SILENT)
        stack = Stack(NAMESPACE, self)
        stack.attribute_service = _Attributes(stack.aspace, self)
        await stack.init()
        _add_nodes(stack.node_mgt_service, stack.aspace, self)
        port = await stack.open(host, port)
        self._stack = stack
        self._sampler = asyncio.create_task(self._sample_monitored(stack))
        return port

    async def close(self) -> None:
        """Stop listening and drop every connection. Idempotent."""
        if self._stack is None or self._sampler is None:
            return
        stack, sampler = self._stack, self._sampler
        self._stack = self._sampler = None
        sampler.cancel()
        await stack.close()
        await asyncio.wait([sampler])
        if not sampler.cancelled():
            sampler.result()

    # One request, one instant: nothing here waits, so that nothing else acts in between.

    def answer_read(self, body: bytes, handle: int) -> bytes | None:
        """The response to a ReadRequest's bytes behind its header; None when it asks for anything but the variables."""
        plan = self._plans.get(body)
        if plan is None:
            plan = plan_read(body, self.variables, _INDEX)
            if plan is None:
                return None
            if len(self._plans) >= _PLANS:
                self._plans.clear()
            self._plans[body] = plan
        self.sample(plan.devices)
        with _Failing():
            return encode_read(plan, handle, _ticks())

    def answer_write(self, body: bytes, handle: int) -> bytes | None:
        """The response to a WriteRequest's bytes behind its header; None when it is not one for the variables."""
        values = parse_write(body, self.variables, _INDEX)
        return None if values is None else encode_write(self.write(values), handle, _ticks())

    def sample(self, devices: Iterable[Device]) -> None:
        """Measure: the variables of these devices tell of this instant."""
        with _Failing():
            now_s = self.clock()
            for device in devices:
                device.sample(now_s)

    def write(self, values: Sequence[WrittenValue | Status]) -> list[Status]:
        """Let the values of one request act, or none of them. A status in the place of a value is its refusal."""
        statuses = [v if isinstance(v, Status) else v.variable.check(v.kind, v.value) for v in values]
        if any(statuses):
            return [status or Status.BAD_TRANSACTION_FAILED for status in statuses]
        with _Failing():
            write(((v.variable, v.value) for v in values if not isinstance(v, Status)), self.clock())
        return statuses

    async def _sample_monitored(self, stack: Stack) -> None:
        """Tell subscribers what has changed."""
        held = {v: stack.aspace[_node_id(v)].attributes[ua.AttributeIds.Value] for v in self.variables.values()}
        while True:
            await asyncio.sleep(_SAMPLING_S)
            if not stack.subscription_service.subscriptions:
                continue
            monitored = [variable for variable, value in held.items() if value.datachange_callbacks]
            self.sample({variable.device for variable in monitored})
            stamp = datetime.now(UTC)
            for variable in monitored:
                value = _data_value(variable, stamp)
                for handle, tell in list(held[variable].datachange_callbacks.items()):
                    try:
                        await tell(handle, value)
                    except Exception:
                        # A filter that fits no data change: it is the subscriber's own and nobody else's.
                        self.malformed += 1
                        stack.aspace.delete_datachange_callback(handle)


class _Failing:
    """asyncua answers whatever goes wrong, and goes on. A line that has failed must not: the event loop is told."""

    def __enter__(self) -> None: ...

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is not None:
            message = "the simulated line failed in an OPC UA request"
            asyncio.get_running_loop().call_exception_handler({"message": message, "exception": error})


class _Attributes(AttributeService):
    """Read and Write as far as they are not answered from the bytes: other nodes and attributes, odd requests."""

    def __init__(self, nodes: AddressSpace, face: OpcUaFace) -> None:
        super().__init__(nodes)
        self._face = face

    def read(self, params: Any) -> list[Any]:
        _check_count(len(params.NodesToRead))
        wanted = [self._variable(item.NodeId, item.AttributeId) for item in params.NodesToRead]
        self._face.sample({variable.device for variable in wanted if variable is not None})
        stamp = datetime.now(UTC)
        return [self._read(item, variable, stamp) for item, variable in zip(params.NodesToRead, wanted, strict=True)]

    async def write(self, params: Any, user: User = _SERVER) -> list[Any]:
        if user.role is UserRole.Admin:  # the server itself, at its start: nobody from outside has this role
            return await super().write(params, user)
        _check_count(len(params.NodesToWrite))
        statuses = self._face.write([self._written(item) for item in params.NodesToWrite])
        return [ua.StatusCode(int(status)) for status in statuses]

    def _read(self, item: Any, variable: Variable | None, stamp: datetime) -> Any:
        if item.IndexRange:  # there are no arrays to take a part of
            return ua.DataValue(StatusCode=ua.StatusCode(ua.StatusCodes.BadIndexRangeNoData))
        if variable is None:
            return self._aspace.read_attribute_value(item.NodeId, ua.AttributeIds(item.AttributeId))
        return _data_value(variable, stamp)

    def _written(self, item: Any) -> WrittenValue | Status:
        variable = self._variable(item.NodeId, item.AttributeId)
        if variable is None:
            return Status.BAD_NOT_WRITABLE if item.NodeId in self._aspace else Status.BAD_NODE_ID_UNKNOWN
        data, value = item.Value, item.Value.Value
        if item.IndexRange or (data.StatusCode is not None and data.StatusCode.value != 0):
            return Status.BAD_WRITE_NOT_SUPPORTED
        if value is None or value.is_array or not isinstance(value.Value, bool | int | float):
            return Status.BAD_TYPE_MISMATCH if variable.accepts else Status.BAD_NOT_WRITABLE
        return WrittenValue(variable, value.VariantType.value, value.Value)

    def _variable(self, node_id: Any, attribute: int) -> Variable | None:
        if attribute != VALUE or node_id.NamespaceIndex != _INDEX or not isinstance(node_id.Identifier, str):
            return None
        return self._face.variables.get(node_id.Identifier)


def _check_count(count: int) -> None:
    if count == 0:
        raise ServiceError(ua.StatusCodes.BadNothingToDo)
    if count > MAX_NODES:
        raise ServiceError(ua.StatusCodes.BadTooManyOperations)


def _ticks() -> int:
    return time.time_ns() // 100 + _EPOCH_TICKS


def _node_id(variable: Variable) -> Any:
    return ua.NodeId(variable.node_name, _INDEX)


def _data_value(variable: Variable, stamp: datetime) -> Any:
    """The variable as it was sampled last. A bad value is none (OPC UA part 4, 7.11)."""
    status = variable.status()
    value = ua.Variant() if status.is_bad else _variant(variable, variable.read())
    return ua.DataValue(value, ua.StatusCode(int(status)), SourceTimestamp=stamp)


def _variant(variable: Variable, value: Scalar | str) -> Any:
    return ua.Variant(value, ua.VariantType(variable.kind))


def _add_nodes(service: NodeManagementService, nodes: AddressSpace, face: OpcUaFace) -> None:
    """Objects and variables, with what a browser shows of them."""
    ids = ua.ObjectIds

    def add(parent: Any, reference: int, node_id: Any, name: str, item: Any) -> None:
        item.ParentNodeId, item.ReferenceTypeId = parent, ua.NodeId(reference)
        item.RequestedNewNodeId, item.BrowseName = node_id, ua.QualifiedName(name, _INDEX)
        [result] = service.add_nodes([item])
        result.StatusCode.check()

    for device in face.devices:
        here = ua.NodeId(device.name, _INDEX)
        attributes = ua.ObjectAttributes(DisplayName=ua.LocalizedText(device.name))
        item = ua.AddNodesItem(NodeClass=ua.NodeClass.Object, NodeAttributes=attributes)
        item.TypeDefinition = ua.NodeId(ids.BaseObjectType)
        add(ua.NodeId(ids.ObjectsFolder), ids.Organizes, here, device.name, item)
    for variable in face.variables.values():
        access = _READ_ONLY if variable.accepts is None else _READ_WRITE
        attributes = ua.VariableAttributes(
            DisplayName=ua.LocalizedText(variable.name),
            Description=ua.LocalizedText(variable.unit),
            Value=_variant(variable, variable.kind.zero),
            DataType=ua.NodeId(int(variable.kind)),
            ValueRank=-1,
            AccessLevel=access,
            UserAccessLevel=access,
            MinimumSamplingInterval=1000.0 * _SAMPLING_S,
        )
        item = ua.AddNodesItem(NodeClass=ua.NodeClass.Variable, NodeAttributes=attributes)
        item.TypeDefinition = ua.NodeId(ids.BaseDataVariableType)
        parent = ua.NodeId(variable.device.name, _INDEX)
        add(parent, ids.HasComponent, _node_id(variable), variable.name, item)

        def current(*_: object, variable: Variable = variable) -> Any:
            face.sample([variable.device])
            return _data_value(variable, datetime.now(UTC))

        nodes.set_attribute_value_callback(_node_id(variable), ua.AttributeIds.Value, current)
