"""What a client may ask of an item that it watches. asyncua looks at a filter only when there is something to tell, and
raises then at what it cannot do: one client's filter would end what tells all others.
"""

from typing import Any

from asyncua import ua as asyncua_ua
from asyncua.server.monitored_item_service import MonitoredItemService, WhereClauseEvaluator

MAX_SELECTS = 100  #: fields of an event that one item asks for
MAX_ELEMENTS = 50  #: of the condition by which an item chooses events
MAX_OPERANDS = 500  #: of all elements of a condition together

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

_HAS_SUBTYPE = ua.NodeId(ua.ObjectIds.HasSubtype)
_ATTRIBUTES = frozenset(int(one) for one in ua.AttributeIds)


class Chooser(WhereClauseEvaluator):
    """By the condition of an item. OfType holds of subtypes as well (OPC 10000-4, 7.7.3); asyncua's is of one alone."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self._lineages: dict[Any, frozenset[Any]] = {}  #: by type; they do not change

    def _eval_el(self, index: int, event: Any) -> Any:
        element = self.elements[index]
        if element.FilterOperator != ua.FilterOperator.OfType:
            return super()._eval_el(index, event)
        if event.EventType not in self._lineages:
            self._lineages[event.EventType] = frozenset(self._lineage(event.EventType))
        return self._eval_op(element.FilterOperands[0], event) in self._lineages[event.EventType]

    def _lineage(self, kind: Any) -> list[Any]:
        """A type, and all that it is derived from."""
        found = [kind]
        for one in found:
            references = self._aspace[one].references
            above = [ref.NodeId for ref in references if ref.ReferenceTypeId == _HAS_SUBTYPE and not ref.IsForward]
            found += [node_id for node_id in above if node_id not in found]
        return found


class Items(MonitoredItemService):
    """The items of one subscription."""

    def event_items(self) -> int:
        return sum(held.where_clause_evaluator is not None for held in self._monitored_items.values())

    def is_of_events(self, number: int) -> bool:
        held = self._monitored_items.get(number)
        return held is not None and held.where_clause_evaluator is not None

    def items(self) -> int:
        return len(self._monitored_items)

    def _create_events_monitored_item(self, params: Any) -> Any:
        if not _chooses_events(params.RequestedParameters.Filter):
            return ua.MonitoredItemCreateResult(StatusCode=ua.StatusCode(ua.StatusCodes.BadFilterNotAllowed))
        result = super()._create_events_monitored_item(params)
        if (made := self._monitored_items.get(result.MonitoredItemId)) is not None:
            made.where_clause_evaluator = Chooser(self.logger, self.aspace, made.filter.WhereClause)
        return result

    async def _create_data_change_monitored_item(self, params: Any) -> Any:
        wanted = params.RequestedParameters
        wanted.Filter = _or_none(wanted.Filter)
        if not _chooses_changes(wanted.Filter):
            return ua.MonitoredItemCreateResult(StatusCode=ua.StatusCode(ua.StatusCodes.BadFilterNotAllowed))
        return await super()._create_data_change_monitored_item(params)

    def _modify_monitored_item(self, params: Any) -> Any:
        held, wanted = self._monitored_items.get(params.MonitoredItemId), params.RequestedParameters
        if held is None:
            return ua.MonitoredItemModifyResult(StatusCode=ua.StatusCode(ua.StatusCodes.BadMonitoredItemIdInvalid))
        wanted.Filter = _or_none(wanted.Filter)
        of_events = held.where_clause_evaluator is not None
        if wanted.Filter is not None and not (_chooses_events if of_events else _chooses_changes)(wanted.Filter):
            return ua.MonitoredItemModifyResult(StatusCode=ua.StatusCode(ua.StatusCodes.BadFilterNotAllowed))
        if of_events and wanted.Filter is not None:  # asyncua would go on with the condition that was before
            held.where_clause_evaluator = Chooser(self.logger, self.aspace, wanted.Filter.WhereClause)
        return super()._modify_monitored_item(params)

    def datachange_callback(self, handle: int, value: Any, error: Any = None) -> Any:
        """A node that goes has told its end as a value; asyncua would call it that of the subscription."""
        return None if error is not None else super().datachange_callback(handle, value)

    def _is_deadband_exceeded(self, values: Any, flt: Any) -> bool:
        """Of two numbers alone there is a difference: values without one are null, and others are texts."""
        both = (values.get_old_datavalue(), values.get_current_datavalue())
        if not all(one is not None and one.Value is not None and _is_number(one.Value.Value) for one in both):
            return True
        return super()._is_deadband_exceeded(values, flt)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _or_none(wanted: Any) -> Any:
    """A filter that is left out may come as an object of no type."""
    return None if isinstance(wanted, ua.ExtensionObject) and wanted.TypeId == ua.NodeId() else wanted


def _chooses_changes(wanted: Any) -> bool:
    return wanted is None or isinstance(wanted, ua.uaprotocol_auto.DataChangeFilter)  # as it is decoded


def _chooses_events(wanted: Any) -> bool:
    if not isinstance(wanted, ua.EventFilter):
        return False
    selects = wanted.SelectClauses or ()
    return 0 < len(selects) <= MAX_SELECTS and all(map(_is_a_field, selects)) and _ends(wanted.WhereClause)


def _is_a_field(select: Any) -> bool:
    """Names of OPC UA begin with a capital; what does not is asyncua's own, which it would hand out."""
    if not isinstance(select, ua.SimpleAttributeOperand):
        return False
    if not select.BrowsePath:
        select.BrowsePath = []
        return select.AttributeId in _ATTRIBUTES
    names = [one.Name for one in select.BrowsePath]
    return select.AttributeId == ua.AttributeIds.Value and all(bool(name) and name[0].isupper() for name in names)


def _ends(condition: Any) -> bool:
    """Elements lead to later ones, and none twice (OPC 10000-4, 7.4.4.2): otherwise few take for ever."""
    elements: Any = (condition.Elements if isinstance(condition, ua.ContentFilter) else None) or ()
    operands = [(number, one) for number, element in enumerate(elements) for one in element.FilterOperands or ()]
    if len(elements) > MAX_ELEMENTS or len(operands) > MAX_OPERANDS:
        return False
    steps = [(number, one.Index) for number, one in operands if isinstance(one, ua.ElementOperand)]
    return all(number < to for number, to in steps) and len({to for _, to in steps}) == len(steps)
