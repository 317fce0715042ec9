// The page: takes the news that the server streams, and shows them.

import { Camera } from "./camera.js";
import { Chart, clock } from "./chart.js";
import { colour, drawPlan, middle, robotColour, tinted } from "./draw.js";
import { fillBars, nameOf, tellReasons, tellStatements } from "./hypotheses.js";
import { Controls } from "./controls.js";
import { makeLegend, markEmpty, visible } from "./layers.js";
import { tellIncidents, tellNodes, tellRobots, tellTopics, text } from "./panels.js";
import { listen } from "./pointer.js";
import { compose, sceneOf, Walls } from "./scene.js";

const MOST_EVENTS = 1000;
const MARGIN = 3; // m around areas and path where no picture says how far the walls are
const $ = (name) => document.getElementById(name);
const state = {};
const camera = new Camera();
let events = [];
let picture = null;
let image = null;
let team = []; // the robots that are joined, each with its colour and the picture of its map
let mode = "fit"; // or "follow", or "free"
let due = false;
let selected = null; // number of a hypothesis, null for the most probable one
let past = null; // the map at an earlier event, null for now
let hint = ""; // about what was clicked

function redraw() {
  if (!due) {
    due = true;
    requestAnimationFrame(draw);
  }
}

const walls = new Walls(redraw);
const controls = new Controls(camera);
const chart = new Chart($("chart"), (reading) => text($("reading"), reading || "Probability over time; drag to zoom, double click for all"));

// ---- which map is shown

/** The map of the selected hypothesis where it is not the most probable one, against whose map it is a change. */
function alternative() {
  if (past || state.alternatives?.best !== state.graph?.best) return null;
  return state.alternatives?.hypotheses[selected] ?? null;
}

function shownEvent() {
  return past ? events.findLast(({ event }) => event < past.events) : events.at(-1);
}

function draw() {
  due = false;
  const plan = $("plan");
  [camera.width, camera.height] = [plan.clientWidth, plan.clientHeight];
  const other = alternative();
  const scene = sceneOf(past ?? state.graph, other);
  const isLive = !past && !other;
  const robot = isLive ? state.robot && { ...state.robot, live: true } : scene.robot && { pose: scene.robot };
  if (mode === "fit") fit(scene);
  if (mode === "follow" && robot) [camera.x, camera.y] = robot.pose;
  if (!isLive) walls.update();
  const drawn = drawPlan(plan, camera, state, {
    scene, visible, robot, isLive, team: isLive ? team : [], others: isLive ? otherPoses() : [],
    picture: isLive ? picture : null, walls: isLive ? null : walls, paint: other ? colour(selected) : null,
  });
  drawn.events = events.length;
  drawn.bars = $("bars").children.length;
  drawn.selected = other ? selected : null;
  drawn.past = past ? past.events - 1 : null;
  controls.draw(plan);
  plan.dataset.drawn = JSON.stringify(drawn);
  const where = drawn.robot ? `, robot at ${$("position").textContent}` : "";
  plan.setAttribute("aria-label", `Map with ${drawn.areas} areas and ${drawn.arcs} arcs${where}`);
  drawScale();
  markEmpty($("legend"), drawn);
  text($("hint"), hint || (drawn.covariances && drawn.factor > 1 ? `Ellipses of arcs are drawn ${drawn.factor} times as large` : ""));
}

/** Where the robot is under the other hypotheses. */
function otherPoses() {
  const names = new Map((events.at(-1)?.hypotheses ?? []).map((leaf) => [String(leaf[0]), leaf]));
  const others = state.alternatives?.best === state.graph?.best ? state.alternatives?.hypotheses : {};
  return Object.entries(others ?? {}).flatMap(([number, one]) => {
    const area = one.areas.find((each) => each.area === one.area);
    if (!area || !names.has(number) || names.get(number)[3]) return [];
    return [{ pose: compose(area.pose, one.robot), paint: colour(Number(number)), name: `#${number}` }];
  });
}

function fit(scene) {
  const grid = !past && !alternative() ? state.map : null;
  const points = [
    ...scene.areas.map((area) => area.at), ...scene.path,
    ...(state.robot && !state.map ? [state.robot.pose] : []),
    ...(grid ? [grid.origin, grid.origin.map((start, k) => start + grid.size[k])] : []),
    ...team.flatMap(corners),
  ];
  if (points.length === 0) return;
  const [low, high] = [[Infinity, Infinity], [-Infinity, -Infinity]];
  for (const point of points) {
    for (const k of [0, 1]) [low[k], high[k]] = [Math.min(low[k], point[k]), Math.max(high[k], point[k])];
  }
  const margin = grid ? 0 : MARGIN;
  camera.fit(low.map((start) => start - margin), high.map((end, k) => end - low[k] + 2 * margin));
}

/** Where another robot's map and the robot are in this map. */
function corners({ frame, map, robot }) {
  const own = (map ? [0, 1, 2, 3] : []).map((k) => [k & 1, k >> 1].map((far, axis) => map.origin[axis] + far * map.size[axis]));
  return [...own.map((corner) => compose(frame, corner)), ...(robot ? [robot] : [])];
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

function select(hypothesis) {
  const best = events.at(-1)?.hypotheses[0]?.[0];
  selected = hypothesis === selected || (hypothesis === best && selected === null) ? null : hypothesis;
  tellHypotheses();
  redraw();
}

// ---- what the server tells

const shown = {
  about: ({ namespace }) => {
    text($("namespace"), namespace === "/" ? "" : namespace);
    document.title = namespace === "/" ? "hmt_slam" : `hmt_slam ${namespace}`;
  },
  recording: ({ bag, time, ended }) => text($("recording"), `${bag}, ${ended ? "ended" : "recorded"} ${new Date(1000 * time).toLocaleString()}`),
  verdict: ({ level, text: sentence, advice }) => tellVerdict(level, sentence, advice),
  robot: ({ pose: [x, y, theta], ellipse, deviation, turn }) => {
    text($("position"), `${x.toFixed(2)}, ${y.toFixed(2)} m, ${((theta * 180) / Math.PI).toFixed(0)}°`);
    text($("sure"), ellipse === null ? "it may be anywhere" : `±${deviation < 10 ? deviation.toFixed(2) : deviation.toFixed(0)} m, ±${turn.toFixed(1)}°`);
  },
  area: () => tellArea(),
  place: () => tellArea(),
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
    if (anew) showPast(null);
    events = [...(anew ? [] : events), ...more].slice(-MOST_EVENTS);
    if (events.at(-1)?.live === 1) state.look = null; // nothing is open any more
    tellHypotheses();
    chart.show(events, state.events ?? []);
    tellSlider();
  },
  graph: ({ statements }) => tellStatements($("statements"), statements),
  evidence: () => tellHypotheses(),
  alternatives: () => tellHypotheses(),
  events: (happened) => chart.show(events, happened),
  past: () => tellSlider(),
  controls: (allowed) => controls.allow(allowed),
  command: (outcome) => controls.tell(outcome),
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

function tellArea() {
  text($("area"), state.place ? `${state.area}, ${state.place.name}` : state.area ?? "–");
}

function tellLocalized() {
  if (state.localized === undefined) return;
  // The exponential of the entropy: as open as between so many places of the same probability.
  const places = Math.exp(state.entropy ?? 0);
  const open = places < 1.05 ? "" : `, as open as ${places < 10 ? places.toFixed(1) : places.toFixed(0)} places`;
  text($("localized"), `${state.localized ? "yes" : "no"}${open}`);
}

function tellHypotheses() {
  const event = shownEvent();
  if (selected !== null && !past && event && !event.hypotheses.some(([hypothesis]) => hypothesis === selected)) {
    hint = `Hypothesis #${selected} has ended: it was dropped, or its question is decided`;
    selected = null;
  }
  text($("live"), event ? `${event.live} live after ${event.path_length.toFixed(0)} m` : "");
  const best = event?.hypotheses[0]?.[0] ?? null;
  fillBars($("bars"), event, selected ?? best, select);
  tellReasons($("reasons"), selected ?? best, event, past ? null : state.evidence, lackingClosures());
  const leaf = event?.hypotheses.find(([hypothesis]) => hypothesis === selected);
  const which = alternative() && leaf ? `Map under hypothesis ${nameOf(leaf)}` : "";
  const when = past ? "Map of the past" : "";
  text($("banner"), which || when);
}

/** The closures of the most probable hypothesis that the selected one lacks, as pairs of areas. */
function lackingClosures() {
  const closures = new Set((state.graph?.arcs ?? []).filter(({ closure }) => closure).map(({ ends }) => String(ends)));
  return (alternative()?.missing ?? []).filter((ends) => closures.has(String(ends)));
}

/** Draw the robots of the team that are joined, and list all. */
function tellTeam(robots) {
  const before = team;
  team = robots.flatMap((robot, place) => robot.joined ? [{ ...robot, paint: robotColour(place) }] : []);
  team.forEach((robot) => takePicture(robot, before.find(({ name }) => name === robot.name)));
  tellRobots(robots);
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

const source = new EventSource("news");
source.onmessage = ({ data }) => {
  const news = JSON.parse(data);
  Object.assign(state, news);
  for (const [section, content] of Object.entries(news)) shown[section]?.(content);
  redraw();
};
source.onerror = () => tellVerdict(
  "fault", "The page has lost its server.", "Does hmt_slam_view run? The page comes back by itself when it does.");

// ---- the time slider

let wanted = null; // event of the last request

function tellSlider() {
  const times = state.past ?? [];
  const slider = $("time");
  slider.max = times.length;
  const at = wanted === null ? -1 : times.findLastIndex(([event]) => event <= wanted);
  slider.value = at < 0 ? times.length : at;
  slider.disabled = times.length === 0;
  const first = times[0]?.[1];
  text($("when"), at < 0 ? "now" : `${clock(times[at][1] - first)} of ${clock(times.at(-1)[1] - first)}`);
}

async function showPast(event) {
  wanted = event;
  const answer = event === null ? null : await fetch(`past.json?event=${event}`);
  if (wanted !== event) return;
  past = answer?.ok ? await answer.json() : null;
  if (!past) wanted = null;
  if (past) selected = null;
  hint = "";
  chart.mark(wanted);
  tellSlider();
  tellHypotheses();
  redraw();
}

$("time").addEventListener("input", ({ target }) => showPast(state.past?.[Number(target.value)]?.[0] ?? null));
$("now").addEventListener("click", () => showPast(null));

// ---- what people do

$("fit").addEventListener("click", () => choose("fit"));
$("follow").addEventListener("click", () => {
  if (mode === "fit") camera.scale = Math.max(camera.scale, 30);
  choose(mode === "follow" ? "free" : "follow");
});
listen($("plan"), camera, {
  moved: () => choose("free"),
  zoomed: () => choose(mode === "follow" ? "follow" : "free"),
  turned: redraw,
  wanted: choose,
  clicked: ask,
}, controls);
makeLegend($("legend"), redraw);

/** Say in words what is at a pixel: an area, or an arc. */
function ask(pixel) {
  const scene = sceneOf(past ?? state.graph, alternative());
  const near = (thing) => Math.hypot(...camera.toScreen(middle(thing)).map((value, k) => value - pixel[k]));
  const things = [...scene.areas, ...scene.arcs].filter((thing) => near(thing) < 24);
  hint = things.sort((one, other) => near(one) - near(other))[0]?.text ?? "";
  redraw();
}

new ResizeObserver(redraw).observe($("plan"));
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  if (image) picture = tinted(image);
  chart.plot.redraw(false);
  tellHypotheses();
  redraw();
});
