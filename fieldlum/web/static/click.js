"use strict";
// Points are kept in pixels of the panorama. Each change asks the server for the room and draws it.
const byId = id => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
const MAX_UNDO = 200;
const page = {
  about: null,
  clicks: [],
  past: [],
  future: [],
  zoom: 1,
  chosen: -1,
  asked: 0,
  svg: null,
};

function draw(tag, props, ...children) {
  const node = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(props)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}
async function ask(path, body) {
  const answer = await fetch(path, {
    method: body ? "POST" : "GET",
    credentials: "same-origin",
    headers: body ? { "Content-Type": "application/json" } : {},
    body: body ? JSON.stringify(body) : undefined,
  });
  if (!answer.ok)
    throw new Error(
      answer.status === 401
        ? "open the address that the terminal prints now"
        : `error ${answer.status}`,
    );
  return answer.json();
}
function remember() {
  page.past.push(JSON.stringify(page.clicks));
  if (page.past.length > MAX_UNDO) page.past.shift();
  page.future = [];
}
function step(from, to) {
  if (!from.length) return;
  to.push(JSON.stringify(page.clicks));
  page.clicks = JSON.parse(from.pop());
  page.chosen = -1;
  changed();
}
function changed() {
  points();
  solve();
}
function position(event) {
  const box = page.svg.getBoundingClientRect();
  return [
    ((event.clientX - box.left) / box.width) * page.about.width,
    ((event.clientY - box.top) / box.height) * page.about.height,
  ];
}
function clamp(click) {
  click.x_px = Math.min(page.about.width, Math.max(0, click.x_px));
  click.y_px = Math.min(page.about.height, Math.max(0, click.y_px));
}

function points() {
  const layer = page.svg.querySelector("#points"),
    r = 5 / scaleNow();
  layer.replaceChildren(
    ...page.clicks.map((click, k) => {
      const of = click.window ? ` of window ${click.window}` : "";
      const label = `${click.kind}${of}, point ${k + 1}`;
      const node = draw("circle", {
        cx: click.x_px,
        cy: click.y_px,
        r,
        class: `point ${click.kind}`,
        tabindex: 0,
        role: "button",
        "aria-label": label,
        "data-k": k,
      });
      node.addEventListener("focus", () => {
        page.chosen = k;
      });
      return node;
    }),
  );
  if (page.chosen >= 0 && layer.children[page.chosen])
    layer.children[page.chosen].focus({preventScroll: true});
}
function scaleNow() {
  return page.svg.getBoundingClientRect().width / page.about.width || 1;
}

// One question at a time; of changes in the meantime the last one counts.
async function solve() {
  page.asked++;
  if (page.busy) return;
  page.busy = true;
  try {
    for (let seen = -1; seen !== page.asked;) {
      seen = page.asked;
      await solveOnce(seen);
    }
  } finally {
    page.busy = false;
  }
}
async function solveOnce(mine) {
  if (!page.clicks.length) {
    shapes({box: [], window: []}, []);
    rows([]);
    say("Click the corners.");
    return;
  }
  try {
    const a = await ask("/solve.json", {
      clicks: page.clicks,
      camera_height_m: Number(byId("height").value),
    });
    if (mine !== page.asked) return;
    if (a.error) {
      shapes({box: [], window: []}, []);
      rows([]);
      say(`Not yet: ${a.error}`);
      return;
    }
    shapes(a.lines, a.patches);
    rows(a.rows);
    say(
      `The south wall faces ${a.faces}; the clicks fit within ${a.misfit_px.toFixed(2)} px. ` +
        a.notes.join(". "),
    );
  } catch (error) {
    if (mine === page.asked) say(`fieldlum does not answer: ${error.message}`);
  }
}
function say(text) {
  byId("line").textContent = text;
}
function shapes(lines, patches) {
  const layer = page.svg.querySelector("#shapes");
  layer.replaceChildren(
    ...patches.map(p => draw("polygon", {points: p.join(" "), class: "patch"})),
    ...lines.box.map(p => draw("polyline", {points: p.join(" "), class: "box"})),
    ...lines.window.map(p => draw("polyline", {points: p.join(" "), class: "pane"})),
  );
}
function rows(list) {
  byId("rows").replaceChildren(
    ...list.map(row => {
      const unit = row.name.endsWith("_deg") ? "°" : "m",
        digits = unit === "m" ? 3 : 2;
      const tr = document.createElement("tr");
      for (const text of [
        row.name.replace(/_(m|deg)$/, "").replaceAll("_", " "),
        `${row.value.toFixed(digits)} ${unit}`,
        `± ${row.u.toFixed(digits)} ${unit}`,
      ]) {
        const td = document.createElement("td");
        td.textContent = text;
        tr.append(td);
      }
      return tr;
    }),
  );
}
function zoom(factor) {
  const frame = byId("frame"),
    before = frame.scrollWidth;
  const middle = [
    (frame.scrollLeft + frame.clientWidth / 2) / before,
    (frame.scrollTop + frame.clientHeight / 2) / frame.scrollHeight,
  ];
  page.zoom = Math.min(16, Math.max(1, page.zoom * factor));
  byId("stack").style.width = `${100 * page.zoom}%`;
  frame.scrollLeft = middle[0] * frame.scrollWidth - frame.clientWidth / 2;
  frame.scrollTop = middle[1] * frame.scrollHeight - frame.clientHeight / 2;
  points();
}

function pointer() {
  let dragged = -1,
    moved = false;
  page.svg.addEventListener("pointerdown", event => {
    const k = event.target.dataset ? event.target.dataset.k : undefined;
    if (k === undefined) return;
    dragged = Number(k);
    moved = false;
    page.svg.setPointerCapture(event.pointerId);
    event.preventDefault();
  });
  page.svg.addEventListener("pointermove", event => {
    if (dragged < 0) return;
    if (!moved) {
      remember();
      moved = true;
    }
    const click = page.clicks[dragged];
    [click.x_px, click.y_px] = position(event);
    clamp(click);
    page.chosen = dragged;
    points();
  });
  page.svg.addEventListener("pointerup", () => {
    if (dragged >= 0) {
      page.chosen = dragged;
      points();
      if (moved) solve();
      page.justDragged = true;
    }
    dragged = -1;
  });
  page.svg.addEventListener("click", event => {
    if (page.justDragged) {
      page.justDragged = false;
      return;
    }
    if (event.target.dataset && event.target.dataset.k !== undefined) return;
    const [x_px, y_px] = position(event),
      kind = byId("kind").value;
    remember();
    page.clicks.push({
      kind,
      window: kind === "floor" || kind === "ceiling" ? 0 : Number(byId("window").value),
      x_px,
      y_px,
    });
    page.chosen = -1;
    changed();
  });
}
document.addEventListener("keydown", event => {
  if (event.target.tagName === "INPUT" || event.target.tagName === "SELECT") return;
  const moves = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]}[
    event.key
  ];
  const on =
    event.target.dataset && event.target.dataset.k !== undefined && page.clicks[page.chosen];
  if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z") {
    event.preventDefault();
    step(page.past, page.future);
  } else if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "y") {
    event.preventDefault();
    step(page.future, page.past);
  } else if (event.key === "+") zoom(1.5);
  else if (event.key === "-" || event.key === "−") zoom(1 / 1.5);
  else if (on && moves) {
    event.preventDefault();
    remember();
    const by = event.shiftKey ? 5 : 0.5;
    on.x_px += by * moves[0];
    on.y_px += by * moves[1];
    clamp(on);
    changed();
  } else if (on && (event.key === "Delete" || event.key === "Backspace")) {
    event.preventDefault();
    remember();
    page.clicks.splice(page.chosen, 1);
    page.chosen = -1;
    changed();
  }
});

async function start() {
  const a = (page.about = await ask("/room.json"));
  byId("name").textContent = `${a.name}: the room by clicking, ${a.slot}`;
  byId("height").value = a.camera_height_m;
  byId("replace").checked = false;
  byId("replace").disabled = !a.has_room;
  byId("picture").src =
    `/picture/${a.slot}.png?low=${a.scale.low}&high=${a.scale.high}&width=1840&v=${a.scale.stamp}`;
  page.svg = draw(
    "svg",
    {viewBox: `0 0 ${a.width} ${a.height}`, class: "over", "aria-label": "Points on the panorama"},
    draw("g", {id: "shapes"}),
    draw("g", {id: "points"}),
  );
  byId("stack").append(page.svg);
  pointer();
  byId("kind").addEventListener("change", () => {
    byId("window").disabled = ["floor", "ceiling"].includes(byId("kind").value);
  });
  byId("height").addEventListener("input", solve);
  byId("undo").addEventListener("click", () => step(page.past, page.future));
  byId("redo").addEventListener("click", () => step(page.future, page.past));
  byId("in").addEventListener("click", () => zoom(1.5));
  byId("out").addEventListener("click", () => zoom(1 / 1.5));
  byId("frame").addEventListener(
    "wheel",
    event => {
      if (event.ctrlKey) {
        event.preventDefault();
        zoom(event.deltaY < 0 ? 1.25 : 0.8);
      }
    },
    {passive: false},
  );
  byId("save").addEventListener("click", async () => {
    try {
      const s = await ask("/save.json", {
        clicks: page.clicks,
        camera_height_m: Number(byId("height").value),
        replace: byId("replace").checked,
      });
      byId("saved").textContent = s.error
        ? `Not saved: ${s.error}`
        : `Saved: ${s.file}. The session ` +
          (s.taken ? "has this room now." : "keeps the room it has.");
    } catch (error) {
      byId("saved").textContent = `Not saved: ${error.message}`;
    }
  });
  document.body.dataset.ready = "1";
}
start().catch(error => say(error.message));
