"use strict";
// The page asks for tables and draws them. Texts of the session enter as text, never as markup.
// Each redraw replaces the children of a fixed set of elements, so a page open for a month does
// not grow.
const byId = id => document.getElementById(id);
const POLL_MS = 5000,
  HIDDEN_POLL_MS = 60000,
  DAY_MS = 60000,
  STALE_S = 600;
const SIGNS = {done: "●", "made up": "◐", "to do": "○", missed: "✕", aborted: "▲", running: "◉"};
const SVG = "http://www.w3.org/2000/svg";
const view = {
  state: null,
  calendar: null,
  day: null,
  version: "",
  dayAt: 0,
  clockOff: 0,
  answer: null,
  follow: true,
};

function put(tag, props = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(props)) {
    if (name in node) node[name] = value;
    else node.setAttribute(name, value);
  }
  node.append(...children);
  return node;
}
function draw(tag, props, ...children) {
  const node = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(props)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}
function show(id, text) {
  const node = byId(id);
  if (node.textContent !== text) node.textContent = text;
}
function number(value, digits = 0) {
  return value === null || value === undefined ? "–" : value.toFixed(digits);
}

async function ask(path) {
  const answer = await fetch(path, {
    cache: "no-store",
    credentials: "same-origin",
    signal: AbortSignal.timeout(20000),
  });
  if (!answer.ok) throw new Error(answer.status === 401 ? "token" : `error ${answer.status}`);
  return answer.json();
}

function duration(seconds) {
  const s = Math.max(0, Math.round(seconds)),
    h = Math.floor(s / 3600),
    d = Math.floor(h / 24);
  if (d >= 2) return `${d} d ${h % 24} h`;
  const two = value => String(value).padStart(2, "0");
  return (h ? `${h}:${two(Math.floor(s / 60) % 60)}` : `${Math.floor(s / 60)}`) + `:${two(s % 60)}`;
}
function age(seconds) {
  if (seconds < -120) return "at the end of the log"; // imported, beyond the last event
  return seconds < 120
    ? `${Math.round(seconds)} s ago`
    : seconds < 7200
      ? `${Math.round(seconds / 60)} min ago`
      : `${Math.round(seconds / 3600)} h ago`;
}
// Time of the session: the server's, carried on by this browser's steady clock.
function now() {
  return (performance.now() + view.clockOff) / 1000;
}

function tick() {
  const s = view.state;
  if (!s) return;
  if (s.next) {
    const left = Date.parse(s.next.t_utc) / 1000 - now();
    show(
      "countdown",
      s.next.state === "running" ? "being taken" : left > 0 ? duration(left) : "due",
    );
  } else show("countdown", "none");
  const silent = s.irradiance ? now() - Date.parse(s.irradiance.t_utc) / 1000 : 0;
  show("ghi-age", s.irradiance ? age(silent) : "not logged");
  byId("ghi-age").classList.toggle("bad", Boolean(s.running) && silent > STALE_S);
}

function drawState(s) {
  view.state = s;
  view.clockOff = Date.parse(s.now_utc) - performance.now();
  show("name", s.name);
  document.title = `${s.name}: fieldlum`;
  const line = byId("line");
  line.className = "";
  show(
    "line",
    s.rehearsal
      ? `${s.folder}: simulated time of a rehearsal, ${s.now_local}`
      : `${s.folder}; all times are ${s.timezone}`,
  );
  const away = Object.keys(s.devices.away);
  const running = byId("running");
  const finished = s.running === false && !s.next;
  running.className = `big ${(s.running === false && !finished) || away.length ? "bad" : "good"}`;
  running.textContent =
    away.length && s.running
      ? `${away.join(", ")} lost`
      : s.running === null
        ? "cannot tell"
        : s.running
          ? "running"
          : finished
            ? "finished"
            : "not running";
  show(
    "counts",
    Object.entries(s.counts)
      .map(([word, count]) => `${count} ${word}`)
      .join(", ") +
      ` of ${s.slots}` +
      (s.devices.camera ? `; ${s.devices.camera}` : ""),
  );
  show(
    "next",
    s.next
      ? `${s.next.day}, ${s.next.local}; sun ${s.next.sun_altitude_deg}° high`
      : "no slot is ahead",
  );
  show(
    "ghi",
    s.irradiance && s.irradiance.ghi_wm2 !== null ? `${number(s.irradiance.ghi_wm2)} W/m²` : "–",
  );
  show("disk", `${(s.disk.free_bytes / 1e9).toFixed(1)} GB free`);
  const power = [];
  if (s.disk.days !== null) power.push(`${Math.floor(s.disk.days)} days of captures`);
  if (s.computer)
    power.push(
      `computer ${s.computer.percent} %${s.computer.mains === false ? ", on battery" : ""}`,
    );
  if (s.devices.camera_battery)
    power.push(`camera battery at the start ${s.devices.camera_battery}`);
  if (s.devices.camera_clock_offset_s !== null && s.devices.camera_clock_offset_s !== undefined) {
    power.push(`camera clock ${s.devices.camera_clock_offset_s.toFixed(1)} s off at the start`);
  }
  show("power", power.join("; "));
  drawLatest(s.latest);
  const words = {fail: "fault", warn: "look", info: "note", ok: "good"};
  byId("events").replaceChildren(
    ...s.events.map(e =>
      put(
        "li",
        {className: e.level},
        put("b", {}, words[e.level]),
        ` ${e.local}: ${e.text}${e.times > 1 ? ` (${e.times} times)` : ""}`,
      ),
    ),
  );
  if (!s.events.length) byId("events").replaceChildren(put("li", {}, "Nothing yet."));
  byId("findings").replaceChildren(
    ...s.findings.map(f =>
      put("li", {className: f.verdict}, put("b", {}, words[f.verdict]), ` ${f.what}: ${f.text}`),
    ),
  );
  tick();
}

function address(slot, scale, width) {
  const stamp = encodeURIComponent(scale.stamp);
  return `/picture/${slot}.png?low=${scale.low}&high=${scale.high}&width=${width}&v=${stamp}`;
}
function drawLatest(latest) {
  const image = byId("latest"),
    legend = byId("legend");
  image.classList.toggle("hidden", !latest);
  legend.classList.toggle("hidden", !latest);
  if (!latest) {
    show("latest-text", "No panorama is merged yet: fieldlum merge SESSION.");
    return;
  }
  const src = address(latest.slot, latest, 1200);
  if (image.getAttribute("src") !== src) image.src = src;
  image.alt = `Luminance of ${latest.slot} in false colour`;
  show("latest-text", `${latest.local || latest.slot}: ${latest.verdict}`);
  show("low", `${latest.low}`);
  show("high", `${latest.high} cd/m²`);
}

function drawCalendar(c) {
  view.calendar = c;
  const months = new Map();
  for (const day of c.days) {
    const name = day.date.slice(0, 7);
    if (!months.has(name)) months.set(name, []);
    months.get(name).push(day);
  }
  const nodes = [];
  for (const [name, days] of months) {
    const title = new Date(`${name}-15T12:00:00Z`).toLocaleDateString("en", {
      month: "long",
      year: "numeric",
      timeZone: "UTC",
    });
    nodes.push(
      put("p", {className: "month-name"}, title),
      put("div", {className: "month"}, ...days.map(dayButton)),
    );
  }
  byId("calendar").replaceChildren(...nodes);
}
function dayButton(day) {
  const counts = {};
  for (const slot of day.slots) counts[slot.state] = (counts[slot.state] || 0) + 1;
  const label =
    `${day.date}: ` +
    Object.entries(counts)
      .map(([word, n]) => `${n} ${word}`)
      .join(", ");
  const signs = put(
    "small",
    {"aria-hidden": "true"},
    ...day.slots.map(slot =>
      put(
        "span",
        {className: `slot ${slot.state.replace(" ", "-")}`, title: `${slot.local} ${slot.state}`},
        SIGNS[slot.state],
      ),
    ),
  );
  const button = put(
    "button",
    {
      type: "button",
      className: "day",
      "aria-label": label,
      "aria-pressed": String(view.day !== null && view.day.date === day.date),
    },
    weekday(day.date),
    signs,
  );
  button.dataset.date = day.date;
  button.addEventListener("click", () => {
    choose(day.date);
    byId("h-day").scrollIntoView({block: "start"});
  });
  return button;
}
function weekday(date) {
  return new Date(`${date}T12:00:00Z`).toLocaleDateString("en-GB", {
    weekday: "short",
    day: "numeric",
    timeZone: "UTC",
  });
}

function drawDay(d) {
  view.day = d;
  view.dayAt = performance.now();
  show(
    "day-name",
    new Date(`${d.date}T12:00:00Z`).toLocaleDateString("en-GB", {
      weekday: "long",
      day: "numeric",
      month: "long",
      year: "numeric",
      timeZone: "UTC",
    }),
  );
  const strip = byId("strip"),
    at = strip.scrollLeft;
  strip.replaceChildren(
    ...d.slots.map(slot => {
      const picture = slot.picture
        ? put("img", {
            src: address(slot.slot, d.scale, 464),
            alt: `Luminance at ${slot.local}`,
            loading: "lazy",
            width: 232,
            height: 116,
          })
        : put("div", {className: "blank"}, slot.state);
      return put(
        "figure",
        {},
        picture,
        put(
          "figcaption",
          {},
          put("span", {className: `slot ${slot.state.replace(" ", "-")}`}, SIGNS[slot.state]),
          ` ${slot.local}  ${slot.verdict || slot.state}`,
        ),
      );
    }),
  );
  if (!d.slots.length) strip.replaceChildren(put("p", {}, "No slot is planned for this day."));
  strip.scrollLeft = at;
  drawCurve(d);
  for (const button of document.querySelectorAll("button.day")) {
    button.setAttribute("aria-pressed", String(button.dataset.date === d.date));
  }
  byId("before").disabled = !step(-1);
  byId("after").disabled = !step(1);
}

function drawCurve(d) {
  const c = d.irradiance,
    W = Math.max(300, byId("curve").clientWidth),
    H = W < 600 ? 190 : 260,
    L = 40,
    B = 24,
    T = 8;
  const some = c.ghi.concat(c.dni, c.dhi).some(v => v !== null);
  if (!some) {
    byId("curve").replaceChildren();
    show("curve-text", "No irradiance is logged on this day.");
    return;
  }
  const first = Math.floor(c.minutes[0] / 60),
    last = Math.ceil(c.minutes[c.minutes.length - 1] / 60);
  const top = Math.max(
    200,
    Math.ceil(Math.max(...c.ghi.concat(c.dni, c.dhi, c.clear_ghi).map(v => v || 0)) / 200) * 200,
  );
  const x = minute => L + ((minute / 60 - first) / Math.max(1, last - first)) * (W - L - 10);
  const y = value => T + (1 - Math.max(0, value) / top) * (H - T - B);
  const svg = draw("svg", {
    viewBox: `0 0 ${W} ${H}`,
    role: "img",
    "aria-label": "Irradiance of the day in W/m²",
  });
  for (let v = 0; v <= top; v += top > 800 ? 400 : 200) {
    svg.append(
      draw("line", {x1: L, x2: W - 10, y1: y(v), y2: y(v), class: "grid"}),
      draw("text", {x: L - 6, y: y(v) + 4, "text-anchor": "end"}, String(v)),
    );
  }
  for (let h = first; h <= last; h += last - first > 12 || W < 600 ? 2 : 1) {
    svg.append(
      draw(
        "text",
        {x: x(h * 60), y: H - 6, "text-anchor": "middle"},
        `${String(h % 24).padStart(2, "0")}:00`,
      ),
    );
  }
  for (const [name, key] of [
    ["clear", "clear_ghi"],
    ["dni", "dni"],
    ["dhi", "dhi"],
    ["ghi", "ghi"],
  ]) {
    for (const points of runs(c.minutes, c[key])) {
      if (points.length === 1) {
        svg.append(
          draw("circle", {class: `dot ${name}`, cx: x(points[0][0]), cy: y(points[0][1]), r: 3}),
        );
      } else {
        svg.append(
          draw("polyline", {
            class: name,
            points: points.map(([m, v]) => `${x(m).toFixed(1)},${y(v).toFixed(1)}`).join(" "),
          }),
        );
      }
    }
  }
  c.minutes.forEach((m, k) => {
    if (c.flagged[k])
      svg.append(draw("line", {x1: x(m), x2: x(m), y1: H - B, y2: H - B - 10, class: "flag"}));
  });
  byId("curve").replaceChildren(svg);
  const status = Object.entries(c.status)
    .map(([word, n]) => `“${word}”, rows: ${n}`)
    .join(", ");
  byId("curve-text").replaceChildren(
    put("span", {className: "ghi-ink"}, "global"),
    ", ",
    put("span", {className: "dni-ink"}, "direct"),
    ", ",
    put("span", {className: "dhi-ink"}, "diffuse"),
    " in W/m²; dashed: global of a clear sky; ",
    c.flagged_bins || c.impossible_bins
      ? put(
          "span",
          {className: "bad"},
          `red marks: intervals flagged by the instrument: ${c.flagged_bins}, ` +
            `with impossible values: ${c.impossible_bins}${status ? ` (${status})` : ""}.`,
        )
      : "no flags.",
  );
}
// Neighbouring readings as runs of points; a gap of more than 10 minutes is not bridged.
function runs(minutes, values) {
  const found = [];
  let before = null;
  minutes.forEach((m, k) => {
    if (values[k] === null) return;
    if (before === null || m - before > 10) found.push([]);
    found[found.length - 1].push([m, values[k]]);
    before = m;
  });
  return found;
}

const WINDS = [
  "N",
  "NNE",
  "NE",
  "ENE",
  "E",
  "ESE",
  "SE",
  "SSE",
  "S",
  "SSW",
  "SW",
  "WSW",
  "W",
  "WNW",
  "NW",
  "NNW",
];
function wind(azimuth) {
  return `${WINDS[Math.round(azimuth / 22.5) % 16]} ${Math.round(azimuth)}°`;
}
function drawAnswer(a) {
  const last = a.last,
    lines = [];
  byId("answer-section").classList.toggle("hidden", !last && !a.computes);
  if (last)
    lines.push(
      `From ${last.captures} captures, weather ${last.weather}.` +
        (last.synthetic
          ? " The weather is made up: it shows how the answer moves, " +
            "not what this place has. Give --weather FILE."
          : ""),
    );
  else
    lines.push(
      `The answer begins with ${a.least_captures} captures and is computed between slots.`,
    );
  if (a.step) lines.push(`Being computed: ${a.step}.`);
  if (a.problem) lines.push(`The last step failed: ${a.problem}`);
  show("answer-line", lines.join(" "));
  byId("answer-rows").replaceChildren(
    ...(last ? last.protection : []).map(row =>
      put(
        "tr",
        {},
        put("th", {scope: "row"}, wind(row.azimuth_deg)),
        put(
          "td",
          {},
          row.dgp_exceeded === null
            ? "not seen"
            : row.certain
              ? `${row.class} protection`
              : `cannot tell yet (${row.class} is likeliest)`,
        ),
        put(
          "td",
          {},
          row.dgp_exceeded === null
            ? "–"
            : `${number(row.dgp_exceeded, 3)}` +
                (row.low === null ? "" : ` (${number(row.low, 3)} to ${number(row.high, 3)})`),
        ),
      ),
    ),
  );
  const next = [];
  if (last) {
    for (const text of last.warnings.slice(0, 4)) next.push(`Doubt: ${text}`);
  }
  byId("answer-next").replaceChildren(...next.map(text => put("li", {}, text)));
}
function local(t) {
  return new Date(t).toLocaleString("en-GB", {
    weekday: "short",
    day: "numeric",
    month: "short",
    hour: "2-digit",
    minute: "2-digit",
    timeZone: view.state.timezone,
  });
}

function step(by) {
  if (!view.calendar || !view.day) return null;
  const dates = view.calendar.days.map(day => day.date);
  const later = dates.filter(date => (by < 0 ? date < view.day.date : date > view.day.date));
  return later.length ? later[by < 0 ? later.length - 1 : 0] : null;
}
async function choose(date) {
  view.follow = view.state !== null && date === view.state.today;
  try {
    drawDay(await ask(`/day/${date}.json`));
  } catch (error) {
    lost(error);
  }
}
function lost(error) {
  byId("line").className = "lost";
  show(
    "line",
    error.message === "token"
      ? "This address is of an earlier run: open the one that the terminal prints now."
      : `fieldlum watch does not answer (${error.message}); what you see is from before.`,
  );
}

async function refresh() {
  try {
    const s = await ask("/state.json");
    const changed = s.version !== view.version,
      turned = view.state !== null && s.today !== view.state.today;
    drawState(s);
    if (s.answer !== view.answer) {
      drawAnswer(await ask("/answer.json"));
      view.answer = s.answer;
    }
    if (changed) {
      drawCalendar(await ask("/calendar.json"));
      view.version = s.version;
    }
    if (view.day === null || (turned && view.follow)) await choose(nearest(s.today));
    else if (changed || (view.day.date === s.today && performance.now() - view.dayAt > DAY_MS)) {
      drawDay(await ask(`/day/${view.day.date}.json`));
    }
    document.body.dataset.polls = String(Number(document.body.dataset.polls || 0) + 1);
  } catch (error) {
    lost(error);
  }
}
async function poll() {
  await refresh();
  setTimeout(poll, document.hidden ? HIDDEN_POLL_MS : POLL_MS);
}
// Today where it is planned, else the last planned day before it, else the first.
function nearest(today) {
  const dates = view.calendar.days.map(day => day.date);
  return dates.filter(date => date <= today).pop() || dates[0] || today;
}

byId("before").addEventListener("click", () => {
  const date = step(-1);
  if (date) choose(date);
});
byId("after").addEventListener("click", () => {
  const date = step(1);
  if (date) choose(date);
});
byId("today").addEventListener("click", () => {
  if (view.state && view.calendar) choose(nearest(view.state.today));
});
byId("strip").addEventListener("keydown", event => {
  const by = {PageUp: -1, PageDown: 1}[event.key];
  if (by && step(by)) {
    event.preventDefault();
    choose(step(by));
  }
});
let width = innerWidth;
addEventListener("resize", () => {
  if (innerWidth !== width && view.day) {
    width = innerWidth;
    drawCurve(view.day);
  }
});
document.addEventListener("visibilitychange", () => {
  if (!document.hidden) tick();
});
setInterval(tick, 1000);
poll();
