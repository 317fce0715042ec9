// The camera of the plan.

/** From metres in the map to pixels of the canvas, and back. */
export class Camera {
  constructor() {
    [this.x, this.y, this.scale] = [0, 0, 30];
    [this.width, this.height] = [1, 1];
  }

  toScreen([x, y]) {
    return [this.width / 2 + (x - this.x) * this.scale, this.height / 2 - (y - this.y) * this.scale];
  }

  toMap([u, v]) {
    return [this.x + (u - this.width / 2) / this.scale, this.y - (v - this.height / 2) / this.scale];
  }

  /** Zoom so that what is under a pixel stays there. */
  zoom(factor, pixel) {
    const [x, y] = this.toMap(pixel);
    this.scale = Math.min(2000, Math.max(0.5, this.scale * factor));
    const [u, v] = this.toScreen([x, y]);
    this.move(pixel[0] - u, pixel[1] - v);
  }

  move(du, dv) {
    this.x -= du / this.scale;
    this.y += dv / this.scale;
  }

  fit([left, bottom], [width, height]) {
    this.x = left + width / 2;
    this.y = bottom + height / 2;
    this.scale = 0.9 * Math.min(this.width / Math.max(width, 4), this.height / Math.max(height, 4));
  }
}
