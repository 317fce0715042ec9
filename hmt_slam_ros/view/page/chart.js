// The chart of probabilities by uPlot: a stack for every keyframe event, with axes, hover, zoom, and what happened.

import { colour, themed } from "./draw.js";

const HEIGHT = 190; // px
const NEAR = 7; // px between the cursor and an event of the run
const SIGNS = { accepted: "--good", withdrawn: "--attention", incident: "--fault" };

/** Seconds from the first event to each; stamps may jump back, as where a bag begins again. */
export function seconds(events) {
  let sum = 0;
  return events.map((event, k) => (sum += k ? Math.max(0, event.time - events[k - 1].time) : 0));
}

/** Minutes and seconds. */
export function clock(time) {
  const whole = Math.round(time);
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
}

/** A share as people write it. */
export function percent(share) {
  return `${(100 * share).toFixed(share > 0.9995 || share < 0.0005 ? 0 : 1)} %`;
}

export class Chart {
  /** In an element; says what is under the pointer by a callback, "" where nothing is. */
  constructor(element, onHover) {
    [this.element, this.onHover, this.events, this.times, this.happened] = [element, onHover, [], [], []];
    [this.marked, this.zoomed] = [null, false];
    const axis = { stroke: () => themed("--soft"), grid: { stroke: () => themed("--line"), width: 1 }, ticks: { show: false } };
    this.plot = new window.uPlot({
      width: this.width, height: HEIGHT, legend: { show: false }, padding: [8, 8, 0, 0],
      cursor: { y: false, points: { show: false }, drag: { x: true, y: false } },
      scales: { x: { time: false }, y: { range: [0, 1] } },
      axes: [
        { ...axis, size: 28, values: (_, ticks) => ticks.map(clock) },
        { ...axis, size: 46, values: (_, ticks) => ticks.map((tick) => `${Math.round(100 * tick)} %`) },
      ],
      series: [{}, { paths: () => null, points: { show: false } }],
      hooks: {
        drawClear: [(plot) => this.drawStacks(plot)],
        draw: [(plot) => this.drawEvents(plot)],
        setCursor: [(plot) => this.hover(plot)],
        setSelect: [(plot) => (this.zoomed = plot.select.width > 0)],
      },
    }, [[0], [0]], element);
    this.plot.ctx.canvas.id = "course";
    this.plot.ctx.canvas.setAttribute("role", "img");
    this.plot.ctx.canvas.setAttribute("aria-label", "Probabilities over time");
    this.plot.over.addEventListener("dblclick", () => (this.zoomed = false));
    new ResizeObserver(() => this.plot.setSize({ width: this.width, height: HEIGHT })).observe(element);
  }

  get width() {
    return Math.max(160, this.element.clientWidth);
  }

  /** Show keyframe events, and what happened at some of them. */
  show(events, happened) {
    [this.events, this.times] = [events, seconds(events)];
    const number = new Map(events.map(({ event }, k) => [event, k]));
    this.happened = happened.filter(({ event }) => number.has(event)).map((row) => ({ ...row, time: this.times[number.get(row.event)] }));
    const end = Math.max(1, this.times.at(-1) ?? 1);
    this.plot.setData([this.times.length > 1 ? this.times : [0, end], (this.times.length > 1 ? this.times : [0, end]).map(() => 0)], !this.zoomed);
  }

  /** Mark an event of the past by a line, or none by null. */
  mark(event) {
    const k = event === null ? -1 : this.events.findLastIndex((one) => one.event <= event);
    this.marked = k < 0 ? null : this.times[k];
    this.plot.redraw(false);
  }

  drawStacks({ ctx, bbox, valToPos }) {
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.fillStyle = themed("--ground");
    ctx.fillRect(bbox.left, bbox.top, bbox.width, bbox.height);
    const end = valToPos(this.times.at(-1) ?? 0, "x", true);
    this.events.forEach((event, k) => {
      const left = Math.round(valToPos(this.times[k], "x", true));
      const right = k + 1 < this.events.length ? Math.round(valToPos(this.times[k + 1], "x", true)) : end + 2;
      if (right < bbox.left || left > bbox.left + bbox.width) return;
      let below = bbox.top + bbox.height;
      for (const [hypothesis, , probability] of inOrder(event)) {
        const size = probability * bbox.height;
        ctx.fillStyle = colour(hypothesis);
        ctx.fillRect(left, below - size, Math.max(right - left, 1), size);
        below -= size;
      }
    });
    ctx.restore();
  }

  drawEvents({ ctx, bbox, valToPos }) {
    ctx.save();
    ctx.lineWidth = 2 * window.devicePixelRatio;
    for (const { kind, time } of this.happened) this.drawLine(ctx, bbox, valToPos(time, "x", true), themed(SIGNS[kind]), kind === "accepted");
    if (this.marked !== null) this.drawLine(ctx, bbox, valToPos(this.marked, "x", true), themed("--ink"), true);
    ctx.restore();
  }

  /** A line with a triangle at its top; over the whole height, or the uppermost part. */
  drawLine(ctx, { left, top, width, height }, at, paint, isWhole) {
    if (at < left || at > left + width) return;
    const size = 5 * window.devicePixelRatio;
    ctx.strokeStyle = ctx.fillStyle = paint;
    ctx.beginPath();
    ctx.moveTo(at, top);
    ctx.lineTo(at, top + (isWhole ? height : 0.25 * height));
    ctx.stroke();
    ctx.beginPath();
    ctx.moveTo(at - size, top - size);
    ctx.lineTo(at + size, top - size);
    ctx.lineTo(at, top + 0.5 * size);
    ctx.fill();
  }

  hover(plot) {
    const { left } = plot.cursor;
    if (left === null || left === undefined || left < 0 || this.events.length === 0) {
      this.onHover("");
      return;
    }
    const time = plot.posToVal(left, "x");
    const k = Math.max(0, this.times.findLastIndex((one) => one <= time));
    const near = this.happened.filter((row) => Math.abs(plot.valToPos(row.time, "x") - left) < NEAR).map(({ text }) => text);
    const shares = this.events[k].hypotheses.slice(0, 4).map(([hypothesis, area, probability, lost]) =>
      `#${hypothesis} ${lost ? "anywhere" : `area ${area}`} ${percent(probability)}`);
    this.onHover([`${clock(this.times[k])}: ${shares.join(", ")}`, ...near].join(" · "));
  }
}

/** By number, so that the band of a hypothesis stays where it is. */
function inOrder({ hypotheses }) {
  return [...hypotheses].sort((one, other) => one[0] - other[0]);
}
