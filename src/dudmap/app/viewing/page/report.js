// The 3D scene of the report: map, trajectory, and camera and moving objects at one time. World frame, metres.
"use strict";

const run = JSON.parse(document.getElementById("run").textContent);
const notice = byId("notice");
const columns = [...document.querySelectorAll(".strip figure")].map((figure) => ({ figure, t: Number(figure.dataset.t) }));

// -- data -------------------------------------------------------------------------------------------------------------

function poseMatrix(pose) {
  const [x, y, z, qx, qy, qz, qw] = pose;
  const one = new THREE.Vector3(1, 1, 1);
  return new THREE.Matrix4().compose(new THREE.Vector3(x, y, z), new THREE.Quaternion(qx, qy, qz, qw), one);
}

// -- scene ------------------------------------------------------------------------------------------------------------

function lines(points, color, loop = false) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(points.flat()), 3));
  const material = new THREE.LineBasicMaterial({ color });
  return loop ? new THREE.Line(geometry, material) : new THREE.LineSegments(geometry, material);
}

function frustum(camera, far) {
  const corner = (u, v) => [((u - camera.cx) / camera.fx) * far, ((v - camera.cy) / camera.fy) * far, far];
  const [a, b, c, d] = [corner(0, 0), corner(camera.width, 0), corner(camera.width, camera.height), corner(0, camera.height)];
  const o = [0, 0, 0];
  return lines([o, a, o, b, o, c, o, d, a, b, b, c, c, d, d, a].map((point) => [...point]), 0xff8a3d);
}

const MOVER_COLORS = [0xff4d6d, 0x4dabf7, 0xffd43b, 0x69db7c, 0xda77f2, 0x3bc9db];

// Mean of the upward directions (-y) of all cameras.
function meanUp(poses) {
  const up = new THREE.Vector3();
  for (const pose of poses) up.sub(new THREE.Vector3().setFromMatrixColumn(pose, 1));
  return up.lengthSq() > 1e-6 ? up.normalize() : new THREE.Vector3(0, -1, 0);
}

class View extends Stage {
  constructor() {
    const poses = run.poses.map(poseMatrix);
    super(meanUp(poses));
    this.poses = poses;
    this.movers = new THREE.Group();
    this.marks = new THREE.Group();
    this.body = frustum(run.camera, 0.25);
    this.body.matrixAutoUpdate = false;
    this.path = lines(run.poses.map((pose) => pose.slice(0, 3)), 0x4dd0ff, true);
    this.sun = new THREE.DirectionalLight(0xffffff, 2.2);
    this.scene.add(new THREE.AmbientLight(0xffffff, 1.2), this.sun, this.movers, this.marks, this.body, this.path);
  }

  setMesh(geometry) {
    this.plain = new THREE.MeshBasicMaterial({ vertexColors: true });
    this.shaded = new THREE.MeshLambertMaterial({ color: 0xc9d1d9 });
    this.mesh = new THREE.Mesh(geometry, this.plain);
    this.scene.add(this.mesh);
  }

  // From behind and above the first camera, at a distance that shows the whole map and the trajectory. Walls are
  // transparent from behind.
  home() {
    const back = new THREE.Vector3().setFromMatrixColumn(this.poses[0], 2).negate().addScaledVector(this.up, 0.5);
    back.normalize();
    const right = new THREE.Vector3().crossVectors(this.up, back).normalize();
    const axes = [right, new THREE.Vector3().crossVectors(back, right), back];
    const points = this.mapPoints().map((point) => axes.map((axis) => axis.dot(point)));
    const most = (value) => points.reduce((largest, point) => Math.max(largest, value(point)), -Infinity);
    const tangent = Math.tan((this.camera.fov * Math.PI) / 360) * 0.96;
    let away = most((point) => point[2]) + 0.5;
    const place = [tangent * this.camera.aspect, tangent].map((reach, k) => {
      const low = most((point) => point[2] - point[k] / reach);
      const high = most((point) => point[2] + point[k] / reach);
      away = Math.max(away, (high + low) / 2);
      return (reach * (high - low)) / 2;
    });
    const at = (distance) => new THREE.Vector3(...place, distance).applyMatrix4(new THREE.Matrix4().makeBasis(...axes));
    this.camera.position.copy(at(away));
    this.controls.target.copy(at((most((point) => point[2]) - most((point) => -point[2])) / 2));
    this.controls.update();
  }

  // Evenly chosen points of the map, and the positions of all cameras.
  mapPoints() {
    const points = this.poses.map((pose) => new THREE.Vector3().setFromMatrixPosition(pose));
    const vertices = this.mesh?.geometry.getAttribute("position");
    const step = vertices ? Math.ceil(vertices.count / 50000) : 1;
    for (let i = 0; i < (vertices?.count ?? 0); i += step) points.push(new THREE.Vector3().fromBufferAttribute(vertices, i));
    return points;
  }

  ride(index) {
    const pose = this.poses[index];
    const { fy, height } = run.camera;
    this.camera.fov = (360 / Math.PI) * Math.atan(height / 2 / fy);
    this.camera.position.setFromMatrixPosition(pose);
    this.camera.up.setFromMatrixColumn(pose, 1).negate();
    const ahead = new THREE.Vector3().setFromMatrixColumn(pose, 2);
    this.camera.lookAt(this.camera.position.clone().add(ahead));
  }

  leave() {
    this.camera.fov = 55;
    this.camera.up.copy(this.up);
    this.home();
  }

  showMovers(list) {
    this.movers.clear();
    for (const mover of list) this.movers.add(boxEdges(mover.box, MOVER_COLORS[mover.id % MOVER_COLORS.length]));
  }

  hit(event) {
    if (!this.mesh) return null;
    const frame = this.renderer.domElement.getBoundingClientRect();
    const x = ((event.clientX - frame.left) / frame.width) * 2 - 1;
    const y = 1 - ((event.clientY - frame.top) / frame.height) * 2;
    const ray = new THREE.Raycaster();
    ray.setFromCamera(new THREE.Vector2(x, y), this.camera);
    return ray.intersectObject(this.mesh)[0]?.point ?? null;
  }

  mark(points) {
    this.marks.clear();
    for (const point of points) {
      const ball = new THREE.Mesh(new THREE.SphereGeometry(0.015), new THREE.MeshBasicMaterial({ color: 0xffe066 }));
      ball.position.copy(point);
      this.marks.add(ball);
    }
    if (points.length === 2) this.marks.add(lines(points.map((point) => point.toArray()), 0xffe066));
  }

  draw() {
    this.sun.position.copy(this.camera.position);
    super.draw();
  }
}

// -- the frame at the slider ------------------------------------------------------------------------------------------

function nearestColumn(t) {
  let best = null;
  for (const column of columns) if (!best || Math.abs(column.t - t) < Math.abs(best.t - t)) best = column;
  return best;
}

function showImages(t) {
  const column = nearestColumn(t);
  if (!column) return;
  const [color, mask] = [...column.figure.querySelectorAll("img")].map((image) => image.src);
  const { depth, residuals } = column.figure.dataset;
  const sources = {
    colour: color, "what moves, red": mask, "depth, blue 0 to red 5 m": depth,
    "residuals, blue -5 cm to red 5 cm, dark off the map": residuals,
  };
  byId("now").replaceChildren(...Object.entries(sources).filter(([, source]) => source).map(([name, source]) => {
    const [figure, image, caption] = ["figure", "img", "figcaption"].map((tag) => document.createElement(tag));
    image.src = source;
    caption.textContent = image.alt = `${name}; ${(column.t - run.times[0]).toFixed(2)} s`;
    figure.append(image, caption);
    return figure;
  }));
}

function showFrame(view, index) {
  const movers = run.movers[index] ?? [];
  const speeds = movers.map((mover) => `object ${mover.id}: ${mover.speed.toFixed(2)} m/s`);
  byId("clock").textContent = [`${(run.times[index] - run.times[0]).toFixed(2)} s`, ...speeds].join(" | ");
  showImages(run.times[index]);
  if (!view) return;
  view.body.matrix.copy(view.poses[index]);
  view.showMovers(movers);
  if (byId("ride").checked) view.ride(index);
  view.draw();
}

// -- controls ---------------------------------------------------------------------------------------------------------

function connect(view) {
  const time = byId("time");
  let timer = 0;
  time.max = Math.max(run.times.length - 1, 0);
  time.addEventListener("input", () => showFrame(view, Number(time.value)));
  byId("play").addEventListener("click", () => {
    if (timer) return void (clearInterval(timer), (timer = 0));
    const step = Math.max(1, Math.round(run.times.length / 600));
    timer = setInterval(() => {
      time.value = (Number(time.value) + step) % run.times.length;
      showFrame(view, Number(time.value));
    }, 66);
  });
  for (const column of columns) {
    column.figure.addEventListener("click", () => {
      const gaps = run.times.map((t) => Math.abs(t - column.t));
      time.value = gaps.indexOf(Math.min(...gaps));
      showFrame(view, Number(time.value));
    });
  }
  if (view) connectScene(view, time);
}

function connectScene(view, time) {
  const parts = { "show-mesh": view.mesh, "show-path": view.path, "show-camera": view.body, "show-movers": view.movers };
  for (const [id, part] of Object.entries(parts)) {
    byId(id).addEventListener("change", () => {
      if (part) part.visible = byId(id).checked;
      view.draw();
    });
  }
  byId("shape").addEventListener("change", () => {
    if (view.mesh) view.mesh.material = byId("shape").checked ? view.shaded : view.plain;
    view.draw();
  });
  byId("ride").addEventListener("change", () => {
    view.controls.enabled = !byId("ride").checked;
    if (!byId("ride").checked) view.leave();
    showFrame(view, Number(time.value));
  });
  connectPicking(view);
}

// A click, not a drag, picks a point; two picked points give their distance.
function connectPicking(view) {
  const canvas = view.renderer.domElement;
  let pressed = null;
  let points = [];
  canvas.addEventListener("pointerdown", (event) => (pressed = event));
  canvas.addEventListener("pointerup", (event) => {
    if (!pressed || Math.hypot(event.clientX - pressed.clientX, event.clientY - pressed.clientY) > 4) return;
    const point = view.hit(event);
    if (!point) return;
    points = points.length === 1 ? [points[0], point] : [point];
    const text = `x ${point.x.toFixed(3)}, y ${point.y.toFixed(3)}, z ${point.z.toFixed(3)} m`;
    const between = points.length === 2 ? `; ${points[0].distanceTo(point).toFixed(3)} m from the point before` : "";
    byId("point").textContent = text + between;
    view.mark(points);
    view.draw();
  });
}

// -- start ------------------------------------------------------------------------------------------------------------

function openView() {
  try {
    return new View();
  } catch (error) {
    notice.textContent = `This browser shows no 3D here, since it has no WebGL (${error.message}); all else is below.`;
    return null;
  }
}

async function start() {
  const view = run.times.length ? openView() : null;
  if (!run.times.length) notice.textContent = "No frame was tracked, so there is neither map nor trajectory.";
  if (view) {
    if (!run.mesh) notice.textContent = "This run has no mesh: no frame was fused.";
    else if (typeof DecompressionStream === "undefined")
      notice.textContent = "This browser is too old to unpack the map (no DecompressionStream); the trajectory is shown.";
    else {
      view.setMesh(await meshGeometry(run.mesh, byId("mesh").textContent));
      notice.textContent = "";
    }
    view.draw(); // sets the aspect ratio of the window
    view.home();
  }
  connect(view);
  if (run.times.length) showFrame(view, 0);
  window.dudmapView = view;
  document.documentElement.dataset.ready = "true";
}

start();
