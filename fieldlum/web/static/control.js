"use strict";
// The controls of `fieldlum watch --control`. Uses put, byId and view of watch.js.
const STATES = {lamp: ["off", "on"], blind: ["up", "half", "down"], snow: ["no", "yes"]};
const PAUSES = {"15 minutes": 15, "1 hour": 60, "4 hours": 240};
const SLOTS_SHOWN = 40;

async function change(action, body) {
  const line = byId("control-line");
  line.className = "";
  line.textContent = "…";
  try {
    const answer = await fetch(`/control/${action}`, {
      method: "POST",
      credentials: "same-origin",
      headers: {"Content-Type": "application/json"},
      body: JSON.stringify(body),
      signal: AbortSignal.timeout(20000),
    });
    if (!answer.ok) throw new Error(`error ${answer.status}`);
    const found = await answer.json();
    line.className = found.error ? "bad" : "good";
    line.textContent = found.error || found.text;
    if (!found.error) refresh();
    return !found.error;
  } catch (error) {
    line.className = "bad";
    line.textContent = `Not done: ${error.message}`;
    return false;
  }
}
function choice(id, label, names) {
  return put(
    "label",
    {htmlFor: id},
    `${label} `,
    put(
      "select",
      {id},
      ...Object.entries(names).map(([text, value]) => put("option", {value: String(value)}, text)),
    ),
  );
}
function button(text, action) {
  const made = put("button", {type: "button"}, text);
  made.addEventListener("click", action);
  return made;
}
function fillSlots() {
  if (!view.calendar) return;
  const slots = view.calendar.days
    .flatMap(day => day.slots)
    .filter(slot => ["done", "running"].includes(slot.state));
  const shown = slots.slice(-SLOTS_SHOWN).reverse(),
    list = byId("mark-slot"),
    chosen = list.value;
  const key = shown.map(slot => slot.slot).join(" ");
  if (list.dataset.key === key) return;
  list.dataset.key = key;
  list.replaceChildren(
    ...shown.map(slot => put("option", {value: slot.slot}, `${slot.day}, ${slot.local}`)),
  );
  if (shown.some(slot => slot.slot === chosen)) list.value = chosen;
}
function build() {
  const note = put("input", {id: "note", maxLength: 500, size: 40});
  const write = async () => {
    if (note.value.trim() && (await change("note", {text: note.value}))) note.value = "";
  };
  note.addEventListener("keydown", event => {
    if (event.key === "Enter") write();
  });
  const states = Object.entries(STATES).map(([word, values]) =>
    choice(`mark-${word}`, word, Object.fromEntries(values.map(value => [value, value]))),
  );
  const mark = () =>
    change("mark", {
      slot: byId("mark-slot").value,
      state: Object.keys(STATES)
        .map(word => `${word}=${byId(`mark-${word}`).value}`)
        .join(";"),
    });
  const section = put(
    "section",
    {"aria-labelledby": "h-control"},
    put("h2", {id: "h-control"}, "Control"),
    put(
      "p",
      {className: "buttons"},
      choice("pause-for", "Begin no bracket for", PAUSES),
      button("Pause", () => change("pause", {minutes: Number(byId("pause-for").value)})),
      button("Go on", () => change("pause", {minutes: 0})),
      button("Extra bracket now", () => change("extra", {})),
    ),
    put(
      "p",
      {className: "buttons"},
      put("label", {htmlFor: "note"}, "Note "),
      note,
      button("Write note", write),
    ),
    put(
      "p",
      {className: "buttons"},
      choice("mark-slot", "Room at", {}),
      ...states,
      button("Mark", mark),
    ),
    put("p", {id: "control-line", role: "status", "aria-live": "polite"}),
  );
  document.querySelector("main").children[0].after(section);
  setInterval(fillSlots, 1000);
}
build();
