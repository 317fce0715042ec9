// The scene: areas, arcs, path and walls of a map, under the most probable hypothesis or another one.

/** The pose of b in the frame of a's frame: a's pose, then b's. */
export function compose([x, y, theta], [u, v, turn = 0]) {
  const [cos, sin] = [Math.cos(theta), Math.sin(theta)];
  return [x + cos * u - sin * v, y + sin * u + cos * v, theta + turn];
}

const DEFINITE = 0.005; // probability that may miss to an arc of all hypotheses

/** Scenes are made once for each map and hypothesis. */
let last = { graph: null, alternative: null, scene: null };

/**
 * The scene of a map, as the section "graph" has it.
 * With an alternative, a part of the section "alternatives", the map as it is under that hypothesis.
 */
export function sceneOf(graph, alternative = null) {
  if (!graph) return { areas: [], arcs: [], path: [], poses: new Map(), robot: null, area: null };
  if (last.graph === graph && last.alternative === alternative) return last.scene;
  const scene = alternative ? makeScene(changed(graph, alternative)) : makeScene(graph);
  last = { graph, alternative, scene };
  return scene;
}

function changed(graph, alternative) {
  const known = new Map(graph.areas.map((area) => [area.area, area]));
  const missing = new Set(alternative.missing.map(String));
  const areas = alternative.areas.map((own) => ({
    keyframes: [], poses: [], text: `Area ${own.area} under this hypothesis`, ...known.get(own.area), ellipse: null, ...own,
  }));
  const arcs = [
    ...graph.arcs.filter(({ ends }) => !missing.has(String(ends))).map((arc) => ({ ...arc, ellipse: null })),
    ...alternative.arcs.map((arc) => ({ ...arc, probability: 0, ellipse: null, text: words(arc) })),
  ];
  return { ...graph, areas, arcs, area: alternative.area, robot: alternative.robot };
}

function words({ ends: [a, b], closure }) {
  return `Area ${b} beside ${a}${closure ? ", a closure of this hypothesis" : ", under this hypothesis"}`;
}

function makeScene({ areas, arcs, area, robot, hypotheses }) {
  const placed = new Map(areas.map((one) => [one.area, one]));
  const examined = hypotheses.reduce((sum, [, probability]) => sum + probability, 0);
  const poses = new Map();
  for (const one of areas) {
    one.keyframes.forEach((keyframe, k) => poses.set(keyframe, compose(one.pose, one.poses[k])));
  }
  const own = [...poses.keys()].filter((keyframe) => keyframe >= 0).sort((one, other) => one - other);
  return {
    areas: areas.map((one) => ({ ...one, at: one.pose.slice(0, 2) })),
    arcs: arcs.filter(({ ends }) => ends.every((end) => placed.has(end))).map((arc) => ({
      ...arc,
      numbers: arc.ends,
      ends: arc.ends.map((end) => placed.get(end).pose.slice(0, 2)),
      candidate: arc.probability < examined - DEFINITE,
    })),
    path: own.map((keyframe) => poses.get(keyframe)),
    poses,
    area,
    robot: placed.has(area) ? compose(placed.get(area).pose, robot) : null,
  };
}

/** Surfaces of keyframes, which the page requests when it shows another map than the picture. */
export class Walls {
  constructor(redraw) {
    [this.points, this.next, this.redraw, this.busy] = [new Map(), 0, redraw, false];
  }

  /** Request what is new. */
  async update() {
    if (this.busy) return;
    this.busy = true;
    try {
      for (let more = true; more;) {
        const answer = await fetch(`walls.json?after=${this.next}`);
        if (!answer.ok) return;
        const news = await answer.json();
        for (const [keyframe, flat] of news.keyframes) this.points.set(keyframe, flat);
        [this.next, more] = [news.next, news.more];
      }
      this.redraw();
    } catch {
      // The server went; the stream says so.
    } finally {
      this.busy = false;
    }
  }

  /** Draw the points of the keyframes of a scene; returns of how many. */
  draw(context, camera, { poses }, paint) {
    context.fillStyle = paint;
    const size = Math.max(1.2, Math.min(3, 0.06 * camera.scale));
    let count = 0;
    for (const [keyframe, [x, y, theta]] of poses) {
      const flat = this.points.get(keyframe);
      if (!flat) continue;
      count += 1;
      const [cos, sin] = [Math.cos(theta) / 100, Math.sin(theta) / 100];
      for (let k = 0; k < flat.length; k += 2) {
        const [u, v] = camera.toScreen([x + cos * flat[k] - sin * flat[k + 1], y + sin * flat[k] + cos * flat[k + 1]]);
        context.fillRect(u - size / 2, v - size / 2, size, size);
      }
    }
    return count;
  }
}
