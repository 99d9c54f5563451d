// Meshes as pages hold them: gzip in base64.
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

