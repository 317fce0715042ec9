// What changes something: save, pause, initial pose, goal and statements; for those who have the token of the page.

import { text } from "./panels.js";

const $ = (name) => document.getElementById(name);
const KEY = "token=";

export class Controls {
  constructor(camera) {
    [this.camera, this.wanted, this.pose, this.paused] = [camera, null, null, false];
    this.token = decodeURIComponent(location.hash.split(KEY)[1] ?? "");
    $("save").addEventListener("click", () => this.send({ kind: "save" }));
    $("pause").addEventListener("click", () => this.send({ kind: this.paused ? "resume" : "pause" }));
    $("state").addEventListener("submit", (event) => {
      event.preventDefault();
      this.send({ kind: "statement", statement: $("statement").value });
    });
    for (const kind of ["initial_pose", "goal"]) $(kind).addEventListener("click", () => this.want(this.wanted === kind ? null : kind));
  }

  /** Show the buttons where the node allows them and the token is there. */
  allow(allowed) {
    $("controls").hidden = !allowed;
    $("state").hidden = !allowed || !this.token;
    for (const button of $("controls").querySelectorAll("button")) button.hidden = !this.token;
    if (allowed && !this.token) this.say("attention", "For buttons open the page by the address that view logged");
  }

  tell({ level, text: sentence, paused }) {
    this.paused = paused;
    text($("pause"), paused ? "Go on" : "Pause");
    this.say(level, sentence);
  }

  say(level, sentence) {
    $("outcome").dataset.level = level;
    text($("outcome"), sentence);
  }

  async send(command) {
    try {
      const answer = await fetch("command", {
        method: "POST", body: JSON.stringify(command),
        headers: { "Content-Type": "application/json", "X-Hmt-Token": this.token },
      });
      if (!answer.ok) this.say("fault", await answer.text());
    } catch {
      this.say("fault", "The page has lost its server");
    }
  }

  /** Wait for a pose on the plan, or no longer. */
  want(kind) {
    [this.wanted, this.pose] = [kind, null];
    for (const name of ["initial_pose", "goal"]) $(name).setAttribute("aria-pressed", String(name === kind));
    $("map").classList.toggle("pointing", kind !== null);
  }

  begin(pixel) {
    if (this.wanted) this.pose = [...this.camera.toMap(pixel), 0];
  }

  /** Turn the pose towards a pixel; returns whether there is one. */
  turn(pixel) {
    if (!this.pose) return false;
    const [x, y] = this.camera.toMap(pixel);
    if (Math.hypot(x - this.pose[0], y - this.pose[1]) * this.camera.scale > 4) this.pose[2] = Math.atan2(y - this.pose[1], x - this.pose[0]);
    return true;
  }

  /** Send the pose, or drop it; returns whether there was one. */
  end(isWanted) {
    if (!this.pose) return false;
    if (isWanted) this.send({ kind: this.wanted, pose: this.pose });
    this.want(null);
    return true;
  }

  /** Draw the pose that is being pointed at. */
  draw(plan) {
    if (!this.pose) return;
    const context = plan.getContext("2d");
    const [u, v] = this.camera.toScreen(this.pose);
    const [du, dv] = [40 * Math.cos(this.pose[2]), -40 * Math.sin(this.pose[2])];
    context.strokeStyle = getComputedStyle(document.documentElement).getPropertyValue("--goal");
    context.lineWidth = 3;
    context.beginPath();
    context.arc(u, v, 8, 0, 2 * Math.PI);
    context.moveTo(u, v);
    context.lineTo(u + du, v + dv);
    context.stroke();
  }
}
