"""Make-up slots of a plan: which missed slot each one repeats."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from fieldlum.core.records import Slot

MAKEUP = "makeup:"  # tag, followed by the missed slot's id


def made_up_for(slots: Sequence[Slot]) -> dict[str, list[Slot]]:
    """Return the make-up slots of each slot that has some, by the id of the original slot.

    The make-up of a missed make-up counts for the first missed slot.
    """
    of = {
        slot.id: tag.removeprefix(MAKEUP)
        for slot in slots
        for tag in slot.tags
        if tag.startswith(MAKEUP)
    }
    makeups: dict[str, list[Slot]] = {}
    for slot in slots:
        if first := of.get(slot.id):
            while first in of:
                first = of[first]
            makeups.setdefault(first, []).append(slot)
    return makeups


def without_capture(slots: Sequence[Slot], captured: Collection[str]) -> tuple[int, int]:
    """Return how many original slots were captured neither themselves nor by a make-up, and of all.

    captured: ids of captured slots. Make-ups are not counted as slots.
    """
    makeups = made_up_for(slots)
    added = {makeup.id for several in makeups.values() for makeup in several}
    original = [slot.id for slot in slots if slot.id not in added]
    done = [
        slot
        for slot in original
        if slot in captured or any(makeup.id in captured for makeup in makeups.get(slot, ()))
    ]
    return len(original) - len(done), len(original)
