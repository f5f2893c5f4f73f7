// What is on the screen: a viewpoint and a look, drawn coarsely while they change and finely once they rest.

const MOVING_SECONDS = 0.047; // with the browser's own work, twenty pictures a second
const STILL_SECONDS = 0.5;
const MOVING_STEPS = 0.25; // of the steps along a ray; 30 dB to what all of them show, as the page has to the exact render
const SETTLE_MILLISECONDS = 200;
const POSES_PER_SECOND = 10;

class Stage {
  /** `fixed`: width and height in pixels, whatever the window's are; null: the window's. */
  constructor(render, viewpoint, look, fixed) {
    Object.assign(this, { render, viewpoint, look, fixed });
    this.scales = { moving: 0.25, still: 0.25 };
    this.flying = null; // while it flies, the time of the last step
    this.settle = 0;
    this.requested = this.coarse = false;
    this.frames = 0;
  }

  size(scale) {
    if (this.fixed) return this.fixed;
    const dense = scale * Math.min(window.devicePixelRatio || 1, 2);
    return [window.innerWidth, window.innerHeight].map((side) => Math.max(1, Math.round(dense * side)));
  }

  draw(moving) {
    const { scales } = this;
    const scale = moving ? scales.moving : scales.still;
    const steps = moving && !this.fixed ? MOVING_STEPS : 1;
    const seconds = this.render(cameraOf(this.viewpoint), this.look, steps, ...this.size(scale));
    const fit = (wanted) => clamp(scale * Math.sqrt(wanted / Math.max(seconds, 1e-4)), [0.1, 1]);
    Object.assign(scales, { moving: fit(MOVING_SECONDS), still: fit(STILL_SECONDS) });
    this.frames++;
    document.body.dataset.state = moving ? "moving" : "ready";
    if (!moving && !this.fixed && scales.still > 1.2 * scale) this.show(false); // quicker than thought: draw it finer
  }

  /** Draws soon: coarsely while anything moves, finely once it rests; of several wishes before a frame, as the last. */
  show(moving) {
    document.body.dataset.state = "moving";
    this.coarse = moving;
    clearTimeout(this.settle);
    if (moving) this.settle = setTimeout(() => this.show(false), SETTLE_MILLISECONDS);
    if (this.requested) return;
    this.requested = true;
    requestAnimationFrame(() => {
      this.requested = false;
      this.draw(this.coarse);
    });
  }

  /** Turns the camera by degrees and moves it nearer or farther. */
  move(yaw, pitch, zoom) {
    this.pause();
    this.viewpoint = moved(this.viewpoint, yaw, pitch, zoom);
    this.show(true);
  }

  /** Goes to the opening camera, or from one photo's camera to the next one's. */
  next() {
    this.pause();
    const { view } = this.viewpoint;
    this.viewpoint = { view: view === undefined ? scene.orbit.opening : (view + 1) % scene.cameras.length };
    this.show(false);
  }

  change(look) {
    Object.assign(this.look, look);
    this.show(true);
  }

  get isFlying() {
    return this.flying !== null;
  }

  /** Flies on from where the flight was last. */
  play() {
    this.flying = performance.now();
    this.viewpoint = { place: this.place ?? 0 };
    const step = (now) => {
      if (!this.isFlying) return;
      const seconds = Math.max(0, now - this.flying) / 1000;
      this.flying = now;
      this.place = (this.viewpoint.place + POSES_PER_SECOND * seconds) % scene.flight.length;
      this.viewpoint = { place: this.place };
      this.show(true);
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
    this.onFlight?.();
  }

  pause() {
    if (!this.isFlying) return;
    this.flying = null;
    this.onFlight?.();
    this.show(false);
  }

  /** The picture as a PNG, as fine as the screen. */
  async picture() {
    this.pause();
    this.render(cameraOf(this.viewpoint), this.look, 1, ...this.size(1));
    const png = await new Promise((done) => canvas.toBlob(done, "image/png"));
    this.show(false);
    return png;
  }
}
