// A page that shows an animation. It reads all of it from the element "data".
import {
  CircleGeometry,
  Color,
  DirectionalLight,
  HemisphereLight,
  Mesh,
  PCFShadowMap,
  PerspectiveCamera,
  Scene,
  ShadowMaterial,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { indices, positions, values } from "./decode.js";
import { Shape } from "./shapes.js";

const SKY = 0.42; // share of the light, and by how much the sky is darker below
const TILT = 0.15;
const element = (id) => document.getElementById(id);

class Player {
  constructor(data, shapes, measures) {
    Object.assign(this, { data, shapes, measures });
    this.frames = data.labels.length;
    const times = data.times ?? data.labels.map((_, k) => k * data.interval);
    this.starts = times.map((time) => time - times[0]);
    this.length = this.starts[this.frames - 1] + (this.frames > 1 ? this.starts[this.frames - 1] - this.starts[this.frames - 2] : 1);
    this.frame = 0;
    this.measure = null;
    this.playing = false;
    this.visible = false;
    this.dirty = true;
    this.drawn = 0; // pictures
    this.scene();
    this.interface();
  }

  scene() {
    const { data, shapes } = this;
    const unit = shapes[0].unit;
    this.world = new Scene();
    this.world.background = new Color(`rgb(${data.background})`);
    for (const shape of shapes) this.world.add(shape.object);
    const up = data.up === "Y" ? [0, 1, 0] : [0, 0, 1];
    const full = SKY * (1 + TILT * (data.sun[data.up === "Y" ? 1 : 2] - 1)) + 1 - SKY;
    const sky = new HemisphereLight(0xffffff, new Color().setScalar(1 - 2 * TILT), (Math.PI * SKY) / full);
    sky.position.set(...up);
    const sun = new DirectionalLight(0xffffff, (Math.PI * (1 - SKY)) / full);
    sun.position.set(...data.sun);
    sun.castShadow = true;
    sun.shadow.mapSize.set(2048, 2048);
    sun.shadow.radius = 8;
    sun.shadow.normalBias = 0.004;
    Object.assign(sun.shadow.camera, { left: -0.6, right: 0.6, bottom: -0.6, top: 0.6, near: 0.05, far: 4 });
    this.world.add(sky, sun);
    if (data.ground !== null) {
      const ground = new Mesh(new CircleGeometry(3, 64), new ShadowMaterial({ opacity: 0.25, depthWrite: false }));
      const height = (data.ground - shapes[0].origin[up.indexOf(1)]) / unit;
      ground.position.fromArray(up).multiplyScalar(height);
      if (data.up === "Y") ground.rotation.x = -Math.PI / 2;
      ground.receiveShadow = true;
      this.world.add(ground);
    }
    this.camera = new PerspectiveCamera(data.camera.fov, 1, 0.01, 50);
    this.camera.up.set(...up);
    this.camera.position.fromArray(data.camera.position.map((value, k) => (value - data.camera.target[k]) / unit));
    this.controls = new OrbitControls(this.camera, element("view"));
    this.controls.dampingFactor = 0.1;
    this.controls.enableDamping = true;
    this.controls.minDistance = 0.05;
    this.controls.maxDistance = 10;
    // In a frame of another page the wheel scrolls that page, until somebody clicks into the picture.
    this.controls.enableZoom = window.parent === window;
    element("view").addEventListener("pointerdown", () => (this.controls.enableZoom = true));
    document.addEventListener("mouseleave", () => (this.controls.enableZoom = window.parent === window));
    this.controls.addEventListener("change", () => (this.dirty = true));
    new ResizeObserver(() => this.resize()).observe(element("view"));
    new IntersectionObserver((entries) => this.see(entries.at(-1).isIntersecting)).observe(element("view"));
  }

  /** Has a context of WebGL while the picture is in view: a browser keeps about 16 of them for all pages of a notebook. */
  see(visible) {
    this.visible = visible;
    if (!this.renderer) {
      if (visible) this.open();
    } else if (visible && this.released) {
      this.context.restoreContext();
      this.released = false;
    } else if (!visible && this.context && !this.renderer.getContext().isContextLost()) {
      this.context.loseContext();
      this.released = true;
    }
  }

  open() {
    try {
      this.renderer = new WebGLRenderer({ antialias: true });
    } catch (error) {
      return refuse(error);
    }
    this.context = this.renderer.getContext().getExtension("WEBGL_lose_context");
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = PCFShadowMap;
    const canvas = this.renderer.domElement;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", this.data.name);
    canvas.addEventListener("webglcontextrestored", () => (this.dirty = true));
    element("view").append(canvas);
    this.resize();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = element("view");
    if (!width || !height || !this.renderer) return;
    this.renderer.setSize(width, height);
    // The motion fits beside the colour bar.
    const room = width - (this.measure ? Math.min(element("bar").offsetWidth + 16, width / 3) : 0);
    const half = Math.tan((this.data.camera.fov * Math.PI) / 360);
    const narrower = Math.max(1, (this.data.camera.aspect * height) / room);
    this.camera.fov = (Math.atan(half * narrower) * 360) / Math.PI;
    this.camera.aspect = room / height;
    this.camera.setViewOffset(room, height, 0, 0, width, height);
    this.dirty = true;
  }

  interface() {
    const { data } = this;
    document.documentElement.style.setProperty("--background", `rgb(${data.background})`);
    element("name").textContent = data.name;
    const slider = element("slider");
    slider.max = this.frames - 1;
    slider.addEventListener("input", () => (this.pause(), this.show(Number(slider.value))));
    element("play").addEventListener("click", () => this.toggle());
    element("speed").addEventListener("change", () => this.restart());
    if (this.frames < 2) for (const id of ["play", "slider", "speed"]) element(id).hidden = true;
    const select = element("colour");
    this.measures.forEach((each, k) => select.add(new Option(each.name || "colour", k)));
    select.hidden = !this.measures.length;
    select.addEventListener("change", () => this.paint(select.value === "" ? null : Number(select.value)));
    element("about").addEventListener("click", () => (element("facts").hidden = !element("facts").hidden));
    element("close").addEventListener("click", () => (element("facts").hidden = true));
    element("note").textContent = `quantised to ${this.rounding()}, for looking, not for measuring${
      data.leftOut ? "; parts are not drawn" : ""
    }`;
    element("text").textContent = this.facts();
    document.addEventListener("keydown", (event) => this.key(event));
  }

  /** The quantum of the positions of the cloth. */
  rounding() {
    return millimetres(this.shapes[this.data.coloured].data.quantum);
  }

  facts() {
    const { data, shapes } = this;
    const cloth = shapes[data.coloured];
    const worst = Math.max(...shapes.map((shape) => shape.data.quantum));
    const others = worst > cloth.data.quantum ? `, those of other shapes to ${millimetres(worst)} or less` : "";
    const colours = this.measures.length ? " Values are quantised to 1/254 of the range of their colour bar." : "";
    const made = data.version ? ` Made by warpcloth ${data.version}.` : "";
    const leftOut = data.leftOut ? ` ${data.leftOut}.` : "";
    return (
      `${this.frames} ${this.frames > 1 ? "frames" : "frame"} of ${cloth.data.count} vertices. ` +
      `Positions are quantised to ${this.rounding()}${others}, for looking, not for measuring.${colours}${leftOut}${made}`
    );
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
    const onButton = event.target.tagName === "BUTTON";
    const step = event.shiftKey ? 10 : 1;
    const actions = {
      " ": () => this.toggle(),
      ArrowLeft: () => this.step(-step),
      ArrowRight: () => this.step(step),
      Home: () => this.step(-this.frame),
      End: () => this.step(this.frames - 1 - this.frame),
    };
    const action = actions[event.key];
    if (!action || (event.key === " " && onButton)) return;
    event.preventDefault();
    action();
  }

  toggle() {
    this.playing ? this.pause() : this.play();
  }

  play() {
    if (this.frames < 2) return;
    this.playing = true;
    this.restart();
    element("play").classList.add("playing");
    element("play").setAttribute("aria-label", "Pause");
  }

  pause() {
    this.playing = false;
    element("play").classList.remove("playing");
    element("play").setAttribute("aria-label", "Play");
  }

  /** Goes on from the frame that is shown. */
  restart() {
    this.clock = { start: performance.now(), from: this.frame === this.frames - 1 ? 0 : this.starts[this.frame] };
  }

  step(by) {
    this.pause();
    this.show(Math.min(Math.max(this.frame + by, 0), this.frames - 1));
  }

  show(frame) {
    this.frame = frame;
    for (const shape of this.shapes) shape.show(frame);
    this.colour();
    element("slider").value = frame;
    const label = `${this.data.labels[frame]}`;
    element("time").textContent = this.data.times ? `${this.data.times[frame].toFixed(2)} s` : label;
    element("time").title = `frame ${label}`;
    this.dirty = true;
  }

  /** Shows a measure as colour, or plain cloth for null. */
  paint(index) {
    this.measure = index === null ? null : this.measures[index];
    element("colour").value = index ?? "";
    element("bar").hidden = index === null;
    if (this.measure) this.legend();
    this.colour();
    this.resize();
  }

  colour() {
    const { surface } = this.shapes[this.data.coloured];
    if (!surface) return;
    const { codes, count, table } = this.measure ?? {};
    surface.paint(codes?.subarray(this.frame * count, (this.frame + 1) * count), table);
  }

  legend() {
    const { name, unit, ticks, excluded, colours } = this.measure;
    const css = (k) => `rgb(${colours.subarray(3 * k, 3 * k + 3)})`;
    const stops = Array.from({ length: 33 }, (_, k) => css(1 + Math.round((k * 254) / 32)));
    element("title").replaceChildren(...name.split("_").flatMap((part, k) => (k ? ["_", document.createElement("wbr"), part] : [part])));
    element("unit").textContent = unit && `[${unit}]`;
    element("scale").style.background = `linear-gradient(to top, ${stops})`;
    element("over").style.background = css(255);
    element("under").style.background = css(1);
    element("ticks").replaceChildren(...ticks.map(([share, text]) => {
      const tick = document.createElement("span");
      tick.style.bottom = `${100 * share}%`;
      tick.textContent = text.replace("-", "−");
      return tick;
    }));
    const longest = Math.max(...ticks.map(([, text]) => text.length));
    element("bar").style.width = `${Math.max(78, 30 + 8 * longest)}px`;
    element("excluded").hidden = !excluded;
    element("excluded").style.setProperty("--colour", css(0));
  }

  loop(now) {
    requestAnimationFrame((next) => this.loop(next));
    if (!this.visible || !this.renderer) return;
    if (this.playing) {
      const passed = ((now - this.clock.start) / 1000) * Number(element("speed").value);
      const time = (this.clock.from + Math.max(passed, 0)) % this.length;
      let frame = this.frame < this.frames && this.starts[this.frame] <= time ? this.frame : 0;
      while (frame + 1 < this.frames && this.starts[frame + 1] <= time) frame++;
      if (frame !== this.frame) this.show(frame);
    }
    this.controls.update();
    if (!this.dirty) return;
    this.dirty = false;
    this.renderer.render(this.world, this.camera);
    if (!this.drawn++) performance.mark("first picture");
  }
}

function millimetres(length) {
  return `${Number((1000 * length).toPrecision(2))} mm`;
}

function linear(bytes) {
  return Float32Array.from(bytes, (byte) => {
    const c = byte / 255;
    return c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4;
  });
}

async function read() {
  const data = JSON.parse(element("data").textContent);
  const { position, target } = data.camera;
  const unit = Math.hypot(...position.map((value, k) => value - target[k]));
  const shapes = await Promise.all(data.shapes.map(async (each) => new Shape(each, {
    positions: await positions(each.positions, each.count),
    triangles: await indices(each.triangles, 3),
    lines: await indices(each.lines, 2),
    balls: await indices(each.balls, 1),
  }, target, unit)));
  const measures = await Promise.all(data.measures.map(async (each) => {
    const colours = Uint8Array.from(atob(each.colours), (c) => c.charCodeAt(0));
    return { ...each, colours, table: linear(colours), codes: await values(each.values, each.count) };
  }));
  return new Player(data, shapes, measures);
}

async function start() {
  // x.html#frame=12&colour=stretch_1 opens at frame 12, standing still, with these colours.
  const asked = new URLSearchParams(window.location.hash.slice(1));
  const player = await read();
  const named = player.measures.findIndex((each) => each.name === asked.get("colour"));
  const frame = player.data.labels.indexOf(Number(asked.get("frame") ?? NaN));
  player.show(Math.max(frame, 0));
  player.paint(asked.has("colour") ? (named < 0 ? null : named) : player.data.opened);
  const still = frame >= 0 || window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  player.loop(performance.now());
  element("wait").hidden = true;
  if (!still) player.play();
  window.player = player; // for scripts
}

function refuse(error) {
  element("wait").hidden = false;
  element("note").hidden = true; // which is in the same lines
  element("wait").textContent = `This browser cannot show the animation, which needs WebGL 2: ${error.message}`;
  console.error(error);
}

start().catch(refuse);
