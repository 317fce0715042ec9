// The page: takes the news that the server streams, and shows them.

import { Camera, colour, drawCourse, drawPlan, middle, robotColour, seconds, themed, tinted } from "./draw.js";

const MOST_EVENTS = 1000;
const TRAIL = 600; // points
const STEP = 0.05; // m between two of them
const $ = (name) => document.getElementById(name);
const state = {};
const camera = new Camera();
let events = [];
let trail = [];
let picture = null;
let image = null;
let team = []; // the robots that are joined, each with its colour and the picture of its map
let mode = "fit"; // or "follow", or "free"
let due = false;

function text(element, content) {
  if (element.textContent !== content) element.textContent = content;
}

function redraw() {
  if (!due) {
    due = true;
    requestAnimationFrame(draw);
  }
}

function draw() {
  due = false;
  const plan = $("plan");
  [camera.width, camera.height] = [plan.clientWidth, plan.clientHeight];
  if (mode === "fit") fit();
  if (mode === "follow" && state.robot) [camera.x, camera.y] = state.robot.pose;
  const drawn = drawPlan(plan, camera, state, picture, trail, team);
  drawn.events = drawCourse($("course"), events);
  drawn.bars = $("bars").children.length;
  plan.dataset.drawn = JSON.stringify(drawn);
  const where = drawn.robot ? `, robot at ${$("position").textContent}` : "";
  plan.setAttribute("aria-label", `Map with ${drawn.areas} areas and ${drawn.arcs} arcs${where}`);
  drawScale();
  if (!chosen) text($("hint"), drawn.arcs && drawn.factor > 1 ? `Ellipses of arcs are drawn ${drawn.factor} times as large` : "");
}

function fit() {
  const points = [
    ...(state.graph?.areas ?? []).map((area) => area.at),
    ...(state.robot && !state.map ? [state.robot.pose] : []),
    ...(state.map ? [state.map.origin, state.map.origin.map((start, k) => start + state.map.size[k])] : []),
    ...team.flatMap(corners),
  ];
  if (points.length === 0) return;
  const low = [0, 1].map((k) => Math.min(...points.map((point) => point[k])));
  const high = [0, 1].map((k) => Math.max(...points.map((point) => point[k])));
  camera.fit(low, high.map((end, k) => end - low[k]));
}

/** Where another robot's map and the robot are in this map. */
function corners({ frame: [x, y, theta], map, robot }) {
  const [cos, sin] = [Math.cos(theta), Math.sin(theta)];
  const own = (map ? [0, 1, 2, 3] : []).map((k) => [k & 1, k >> 1].map((far, axis) => map.origin[axis] + far * map.size[axis]));
  return [...own.map(([u, v]) => [x + cos * u - sin * v, y + sin * u + cos * v]), ...(robot ? [robot] : [])];
}

function drawScale() {
  const wanted = 90 / camera.scale;
  const power = 10 ** Math.floor(Math.log10(wanted));
  const length = [5, 2, 1].map((k) => k * power).find((each) => each <= wanted) ?? power;
  text($("scale").querySelector("span"), length >= 1 ? `${length} m` : `${Math.round(100 * length)} cm`);
  $("scale").querySelector("b").style.width = `${(length * camera.scale).toFixed(0)}px`;
}

function choose(next) {
  mode = next;
  $("follow").setAttribute("aria-pressed", String(mode === "follow"));
  redraw();
}

// ---- what the server tells

const shown = {
  about: ({ namespace }) => {
    text($("namespace"), namespace === "/" ? "" : namespace);
    document.title = namespace === "/" ? "hmt_slam" : `hmt_slam ${namespace}`;
  },
  verdict: ({ level, text: sentence, advice }) => tellVerdict(level, sentence, advice),
  robot: ({ pose: [x, y, theta], ellipse, deviation, turn }) => {
    const last = trail.at(-1);
    if (!last || Math.hypot(x - last[0], y - last[1]) > STEP) trail = [...trail.slice(1 - TRAIL), [x, y]];
    text($("position"), `${x.toFixed(2)}, ${y.toFixed(2)} m, ${((theta * 180) / Math.PI).toFixed(0)}°`);
    text($("sure"), ellipse === null ? "it may be anywhere" : `±${deviation < 10 ? deviation.toFixed(2) : deviation.toFixed(0)} m, ±${turn.toFixed(1)}°`);
  },
  area: (area) => text($("area"), area),
  localized: () => tellLocalized(),
  entropy: () => tellLocalized(),
  replay: ({ state: doing, log, done, scans }) => {
    $("replay").hidden = false;
    $("replay").querySelector("progress").value = scans ? Math.min(1, done / scans) : 0;
    text($("replay").querySelector("span"), `${log}: ${scans ? `${done} of ${scans}` : done} scans, ${doing}`);
  },
  map: ({ tag }) => {
    const next = new Image();
    next.onload = () => {
      image = next;
      picture = tinted(image);
      redraw();
    };
    next.src = `map.png?${tag}`;
  },
  history: ({ anew, events: more }) => {
    if (anew) trail = [];
    events = [...(anew ? [] : events), ...more].slice(-MOST_EVENTS);
    tellHypotheses();
  },
  team: tellTeam,
  nodes: tellNodes,
  topics: tellTopics,
  incidents: tellIncidents,
};

function tellVerdict(level, sentence, advice) {
  $("verdict").dataset.level = level;
  text($("verdict").querySelector("strong"), sentence);
  text($("verdict").querySelector("span"), advice);
}

function tellLocalized() {
  if (state.localized === undefined) return;
  // The exponential of the entropy: as open as between so many places of the same probability.
  const places = Math.exp(state.entropy ?? 0);
  const open = places < 1.05 ? "" : `, as open as ${places < 10 ? places.toFixed(1) : places.toFixed(0)} places`;
  text($("localized"), `${state.localized ? "yes" : "no"}${open}`);
}

function tellHypotheses() {
  const event = events.at(-1);
  if (!event) {
    $("bars").replaceChildren();
    return;
  }
  text($("live"), `${event.live} live after ${event.path_length.toFixed(0)} m`);
  const seen = event.hypotheses.reduce((sum, leaf) => sum + leaf[2], 0);
  const rows = event.hypotheses.map(([hypothesis, area, probability, lost]) =>
    bar(lost ? "Anywhere" : `Area ${area}`, `#${hypothesis}`, probability, colour(hypothesis)));
  if (seen < 0.995) rows.push(bar("Not examined", "", 1 - seen, themed("--line")));
  $("bars").replaceChildren(...rows);
  text($("from"), clock(-seconds(events).at(-1)));
  text($("to"), "now");
}

function bar(name, number, probability, paint) {
  const row = document.createElement("li");
  const [label, track, share] = ["span", "span", "span"].map((kind) => document.createElement(kind));
  label.append(name, " ", Object.assign(document.createElement("small"), { textContent: number }));
  track.className = "track";
  const fill = document.createElement("i");
  fill.style.setProperty("--bar", paint);
  fill.style.width = `${(100 * probability).toFixed(1)}%`;
  track.append(fill);
  share.textContent = probability > 0.9995 || probability < 0.0005
    ? `${(100 * probability).toFixed(0)} %` : `${(100 * probability).toFixed(1)} %`;
  row.append(label, track, share);
  return row;
}

/** Say how the maps of the other robots lie, and draw those that are joined. */
function tellTeam(robots) {
  $("team").hidden = robots.length === 0;
  const before = team;
  team = robots.flatMap((robot, place) => robot.joined ? [{ ...robot, paint: robotColour(place) }] : []);
  team.forEach((robot) => takePicture(robot, before.find(({ name }) => name === robot.name)));
  $("robots").replaceChildren(...robots.map(robotRow));
}

/** Load the picture of a robot's map, or take that of before where it is the same. */
function takePicture(robot, before) {
  robot.picture = before?.picture;
  if (!robot.map || before?.map?.tag === robot.map.tag) return;
  const next = new Image();
  next.onload = () => {
    const now = team.find(({ name }) => name === robot.name);
    if (now) now.picture = tinted(next, now.paint);
    redraw();
  };
  next.src = `map.png?robot=${encodeURIComponent(robot.name)}&${robot.map.tag}`;
}

function robotRow({ name, joined, verdict, probability, apart }, place) {
  const row = document.createElement("li");
  const [dot, label, answer] = ["span", "span", "small"].map((kind) => document.createElement(kind));
  dot.className = "dot";
  row.style.setProperty("--robot-colour", joined ? robotColour(place) : "var(--line)");
  label.textContent = name;
  const best = probability === undefined ? "" : `, best placement ${(100 * probability).toFixed(1)} %`;
  if (verdict === null) answer.textContent = joined ? "joined by others" : "not compared yet";
  else if (joined) answer.textContent = verdict === "joined" ? `joined, ${(100 * probability).toFixed(1)} %` : `joined by others${best}`;
  else answer.textContent = `${verdict}${best}, apart ${(100 * apart).toFixed(1)} %`;
  row.append(dot, label, answer);
  return row;
}

function clock(seconds) {
  const whole = Math.round(Math.abs(seconds));
  const sign = seconds < 0 ? "−" : "";
  return whole < 120 ? `${sign}${whole} s` : `${sign}${Math.round(whole / 60)} min`;
}

function tellNodes(nodes) {
  const box = $("nodes");
  nodes.forEach((node, k) => {
    const row = box.children[k] ?? box.appendChild(emptyNode());
    row.dataset.level = node.level;
    text(row.querySelector(".name"), node.name);
    text(row.querySelector(".figures"), figures(node));
    text(row.querySelector(".said"), node.message === "running" ? "" : node.message);
    if (row.open) fillTable(row.querySelector("tbody"), Object.entries(node.values));
  });
  while (box.children.length > nodes.length) box.lastChild.remove();
}

function emptyNode() {
  const row = document.createElement("details");
  row.innerHTML = '<summary><span class="dot"></span><span class="name"></span><span class="figures"></span>'
    + '<span class="said"></span></summary><table><tbody></tbody></table>';
  row.addEventListener("toggle", () => state.nodes && tellNodes(state.nodes));
  return row;
}

// What a node's rate is about: the first of these that it tells.
const RATES = {
  "received Scan a second": "scans/s",
  "sent Scan a second": "scans/s",
  "received Odometry a second": "odometry/s",
  "received Keyframe a second": "keyframes/s",
};

function figures({ load, values }) {
  const rate = Object.keys(RATES).find((name) => name in values);
  const waiting = Number(values["waiting scans"] ?? 0) + Number(values["waiting for their turn"] ?? 0);
  const dropped = Number(values["dropped scans"] ?? 0);
  return [
    rate ? `${values[rate]} ${RATES[rate]}` : "",
    load === undefined ? "" : `${Math.round(100 * load)} % busy`,
    values["effective samples"] ? `${values["effective samples"]} samples` : "",
    waiting ? `${waiting} waiting` : "",
    dropped ? `${dropped} dropped` : "",
    values.memory ?? "",
  ].filter(Boolean).join(" · ");
}

function tellTopics(topics) {
  const silent = topics.filter(({ age }) => age === null).length;
  text($("silent"), silent ? `${silent} silent so far` : "all were heard");
  fillTable($("topics"), topics.map(({ topic, from, age }) =>
    [`${topic}, from ${from}`, age === null ? "silent" : age < 2 ? "now" : `${age} s ago`]));
}

/** List what happened to the nodes, the newest first. */
function tellIncidents(incidents) {
  const rows = incidents.map(({ time, node, text: sentence }) =>
    [new Date(1000 * time).toLocaleTimeString([], { hour12: false }), `${node}: ${sentence}`]);
  text($("newest"), rows.length ? `${rows[0][0]}, ${incidents[0].node}` : "nothing");
  fillTable($("incidents"), rows);
}

function fillTable(body, rows) {
  rows.forEach((cells, k) => {
    const row = body.rows[k] ?? body.insertRow();
    cells.forEach((content, column) => text(row.cells[column] ?? row.insertCell(), String(content)));
  });
  while (body.rows.length > rows.length) body.deleteRow(-1);
}

const source = new EventSource("news");
source.onmessage = ({ data }) => {
  const news = JSON.parse(data);
  Object.assign(state, news);
  for (const [section, content] of Object.entries(news)) shown[section]?.(content);
  redraw();
};
source.onerror = () => tellVerdict(
  "fault", "The page has lost its server.", "Does hmt_slam_view run? The page comes back by itself when it does.");

// ---- what people do

const pointers = new Map();
let chosen = false;
let travelled = 0;

$("plan").addEventListener("pointerdown", (event) => {
  event.target.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
  travelled = 0;
});
$("plan").addEventListener("pointermove", (event) => {
  const before = pointers.get(event.pointerId);
  if (!before) return;
  const now = [event.offsetX, event.offsetY];
  const [du, dv] = [now[0] - before[0], now[1] - before[1]];
  travelled += Math.hypot(du, dv);
  pointers.set(event.pointerId, now);
  if (travelled < 4) return;
  const others = [...pointers].filter(([id]) => id !== event.pointerId);
  if (others.length === 1) {
    const [, other] = others[0];
    const ratio = Math.hypot(now[0] - other[0], now[1] - other[1])
      / Math.max(1, Math.hypot(before[0] - other[0], before[1] - other[1]));
    camera.zoom(ratio, other);
  } else {
    camera.move(du, dv);
  }
  choose("free");
});
for (const kind of ["pointerup", "pointercancel"]) {
  $("plan").addEventListener(kind, (event) => {
    pointers.delete(event.pointerId);
    if (kind === "pointerup" && travelled < 4) ask([event.offsetX, event.offsetY]);
  });
}
$("plan").addEventListener("wheel", (event) => {
  event.preventDefault();
  camera.zoom(Math.exp(-event.deltaY / 500), [event.offsetX, event.offsetY]);
  choose(mode === "follow" ? "follow" : "free");
}, { passive: false });
$("plan").addEventListener("keydown", ({ key }) => {
  const center = [camera.width / 2, camera.height / 2];
  const steps = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] };
  if (key === "+" || key === "-") camera.zoom(key === "+" ? 1.25 : 0.8, center);
  else if (steps[key]) camera.move(...steps[key]);
  if (key === "0" || key === "f") choose(key === "0" ? "fit" : "follow");
  else if (key === "+" || key === "-" || steps[key]) choose("free");
});
$("fit").addEventListener("click", () => choose("fit"));
$("follow").addEventListener("click", () => {
  if (mode === "fit") camera.scale = Math.max(camera.scale, 30);
  choose(mode === "follow" ? "free" : "follow");
});

/** Say in words what is at a pixel: an area, or an arc. */
function ask(pixel) {
  const near = (thing) => Math.hypot(...camera.toScreen(middle(thing)).map((value, k) => value - pixel[k]));
  const things = [...(state.graph?.areas ?? []), ...(state.graph?.arcs ?? [])].filter((thing) => near(thing) < 24);
  const nearest = things.sort((one, other) => near(one) - near(other))[0];
  chosen = Boolean(nearest);
  if (chosen) text($("hint"), nearest.text);
  redraw();
}

new ResizeObserver(redraw).observe($("plan"));
new ResizeObserver(redraw).observe($("course"));
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  if (image) picture = tinted(image);
  redraw();
});
