// The 3D scene of the page on changes: both maps, and the boxes of what changed. World frame of the visit before, metres.
"use strict";

const data = JSON.parse(document.getElementById("scene").textContent);

function boxOf(change) {
  const [low, high] = change.box.map((corner) => new THREE.Vector3(...corner));
  const size = high.clone().sub(low);
  const edges = new THREE.EdgesGeometry(new THREE.BoxGeometry(size.x, size.y, size.z));
  const lines = new THREE.LineSegments(edges, new THREE.LineBasicMaterial({ color: data.tints[change.kind] }));
  lines.position.copy(low).add(high).multiplyScalar(0.5);
  return lines;
}

class View {
  constructor() {
    this.renderer = new THREE.WebGLRenderer({ canvas: byId("canvas"), antialias: true, preserveDrawingBuffer: true });
    this.renderer.outputColorSpace = "srgb-linear";
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(60, 1, 0.02, 500);
    this.up = new THREE.Vector3(...data.up).normalize();
    this.camera.up.copy(this.up);
    this.controls = new THREE.OrbitControls(this.camera, this.renderer.domElement);
    this.controls.addEventListener("change", () => this.draw());
    this.boxes = new THREE.Group();
    for (const change of data.changes) if (data.tints[change.kind] !== undefined) this.boxes.add(boxOf(change));
    this.scene.add(this.boxes);
    this.ahead = new THREE.Vector3(...data.ahead);
    this.look(new THREE.Vector3(...data.middle), 0.8 * data.size);
    new ResizeObserver(() => this.draw()).observe(this.renderer.domElement.parentElement);
  }

  look(target, distance) {
    this.camera.position.copy(target).addScaledVector(this.ahead, -distance).addScaledVector(this.up, 0.4 * distance);
    this.controls.target.copy(target);
    this.controls.update();
    this.draw();
  }

  flyTo(change) {
    const [low, high] = change.box.map((corner) => new THREE.Vector3(...corner));
    this.look(low.clone().add(high).multiplyScalar(0.5), 1.5 * low.distanceTo(high) + 0.3);
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.renderer.domElement.parentElement;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / Math.max(height, 1);
    this.camera.updateProjectionMatrix();
    this.renderer.render(this.scene, this.camera);
  }
}

async function start() {
  try {
    const view = new View();
    const maps = { boxes: view.boxes };
    for (const [number, name] of ["before", "after"].entries()) {
      const geometry = await meshGeometry(data.meshes[number], byId(`mesh-${name}`).textContent);
      maps[name] = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ vertexColors: true }));
      view.scene.add(maps[name]);
    }
    for (const [name, part] of Object.entries(maps)) {
      const show = () => ((part.visible = byId(name).checked), view.draw());
      byId(name).addEventListener("change", show);
      show();
    }
    for (const row of document.querySelectorAll("#changes li"))
      row.addEventListener("click", () => view.flyTo(data.changes.find((change) => change.id === Number(row.dataset.id))));
    byId("notice").textContent = "";
    window.dudmapView = view;
  } catch (error) {
    byId("notice").textContent = `This browser shows no 3D here (${error.message}); all else is below.`;
  }
  document.documentElement.dataset.ready = "true";
}

start();
