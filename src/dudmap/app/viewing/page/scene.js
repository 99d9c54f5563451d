// Shared by both pages: meshes (gzip in base64), boxes, and the view of a scene.
"use strict";

const byId = (id) => document.getElementById(id);

async function unpacked(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

// Layout (app/viewing/report.py): positions uint16 x 3 over the box, colours uint8 x 3, padding to 4 bytes, differences
// of consecutive indices as int32.
async function meshGeometry(mesh, text) {
  const buffer = await unpacked(text.trim());
  const geometry = new THREE.BufferGeometry();
  const whole = new Uint16Array(buffer, 0, 3 * mesh.vertices);
  const positions = new Float32Array(whole.length);
  for (let i = 0; i < whole.length; i++) {
    const axis = i % 3;
    positions[i] = mesh.low[axis] + (whole[i] / 65535) * (mesh.high[axis] - mesh.low[axis]);
  }
  const colors = new Uint8Array(buffer, 6 * mesh.vertices, 3 * mesh.vertices);
  const start = Math.ceil((9 * mesh.vertices) / 4) * 4;
  const steps = new Int32Array(buffer, start, 3 * mesh.triangles);
  const indices = new Uint32Array(steps.length);
  let last = 0;
  for (let i = 0; i < steps.length; i++) indices[i] = last += steps[i];
  geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  geometry.setAttribute("color", new THREE.BufferAttribute(colors, 3, true));
  geometry.setIndex(new THREE.BufferAttribute(indices, 1));
  geometry.computeVertexNormals();
  return geometry;
}

function boxEdges([[x0, y0, z0], [x1, y1, z1]], color) {
  const box = new THREE.BoxGeometry(x1 - x0, y1 - y0, z1 - z0);
  const edges = new THREE.LineSegments(new THREE.EdgesGeometry(box), new THREE.LineBasicMaterial({ color }));
  edges.position.set((x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2);
  return edges;
}

// The canvas. Recorded colours are shown without tone mapping or conversion of colour spaces.
class Stage {
  constructor(up) {
    this.renderer = new THREE.WebGLRenderer({ canvas: byId("canvas"), antialias: true, preserveDrawingBuffer: true });
    this.renderer.outputColorSpace = "srgb-linear";
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(55, 1, 0.02, 500);
    this.up = up;
    this.camera.up.copy(up);
    this.controls = new THREE.OrbitControls(this.camera, this.renderer.domElement);
    this.controls.addEventListener("change", () => this.draw());
    new ResizeObserver(() => this.draw()).observe(this.renderer.domElement.parentElement);
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.renderer.domElement.parentElement;
    if (width !== this.width || height !== this.height) {
      [this.width, this.height] = [width, height];
      this.renderer.setSize(width, height, false);
    }
    this.camera.aspect = width / Math.max(height, 1);
    this.camera.updateProjectionMatrix();
    this.renderer.render(this.scene, this.camera);
  }
}
