"""`fieldlum status`: show what a session has done and what is still to do."""

from zoneinfo import ZoneInfo

from fieldlum.cli import terminal
from fieldlum.cli.options import OpenSession, command_of
from fieldlum.core.records import JsonTable, counted


@command_of("status")
def command(
    session: OpenSession, mark: tuple[str, str] | None = None, as_json: bool = False
) -> None:
    """Show what a session has done and what is still to do.

    \b
    Example:
      fieldlum status office-2027
      fieldlum status office-2027 --mark 20270320T153000Z lamp=on

    Options:
      --mark SLOT|DATE STATE: Record the room's state at a slot, or at all captured slots of a
          local date: lamp=on|off, blind=up|half|down, tint=clear|half|full,
          snow=yes|no, use=yes|no.
    """
    from fieldlum.session import mark_slot
    from fieldlum.year.stage_status import stage_status

    if mark is not None:
        zone = ZoneInfo(session.site_file().site.timezone)
        taken = {p.stem for p in (*session.captured_folders(), *session.panorama_files())}
        slots = [slot for slot in session.slots() if slot.id in taken]
        day = [s.id for s in slots if s.t_utc.astimezone(zone).date().isoformat() == mark[0]]
        for slot in day or mark[:1]:
            terminal.say(f"{slot}: {mark_slot(session, slot, mark[1]) or 'as usual'}")
    answer = stage_status(session)
    terminal.print_answer(as_json, answer, _lines(answer))


def _lines(answer: JsonTable) -> list[str]:
    """Return the lines that the terminal shows of an answer of `status --json`."""
    from fieldlum.session.journal import damage_text

    plan, capture, log = answer["plan"], answer["capture"], answer["irradiance"]
    merge, pair = answer["merge"], answer["pair"]
    truth = " of the simulated truth" if pair["usable"] and not pair["done"] else ""
    of_set = f" ({plan['set']})" if plan["set"] else ""
    damaged = f"; {text}" if (text := damage_text(capture["damaged_lines"])) else ""
    upcoming = f", next {capture['next']}" if capture["next"] else ""
    report = "done" if answer["report"]["done"] else "none"
    report = "to do again" if answer["report"]["outdated"] else report
    return [
        f"{answer['session']}: {answer['name']}",
        f"plan        {counted(plan['slots'], 'slot')}{of_set}",
        f"capture     {capture['done']} done, {capture['missed']} missed, {capture['aborted']} "
        f"aborted, {capture['owed']} to do{upcoming}; "
        f"{counted(capture['frames'], 'frame')}{damaged}",
        f"irradiance  {counted(log['rows'], 'row')} on {counted(log['days'], 'UTC day')}",
        f"merge       {merge['done']} done, {merge['owed']} to do",
        f"pair        {pair['done']} done, {pair['usable']} usable{truth}, {pair['owed']} to do",
        f"train       {_names(answer['train']['models'], answer['train']['outdated'])}",
        f"predict     {_names(answer['predict']['years'], answer['predict']['outdated'])}",
        f"report      {report}",
        f"next        {answer['next_step']}",
    ]


def _names(names: list[str], outdated: list[str]) -> str:
    """Return a list of names, of which some are outdated."""
    return ", ".join(f"{n} (to do again)" if n in outdated else n for n in names) or "none"
