// The 3D scene of the page on changes: both maps and the boxes of changes. World frame of the earlier visit, metres.
"use strict";

const data = JSON.parse(document.getElementById("scene").textContent);

class View extends Stage {
  constructor() {
    super(new THREE.Vector3(...data.up).normalize());
    this.boxes = new THREE.Group();
    for (const { kind, box } of data.changes)
      if (data.tints[kind] !== undefined) this.boxes.add(boxEdges(box, data.tints[kind]));
    this.scene.add(this.boxes);
    this.ahead = new THREE.Vector3(...data.ahead);
    this.look(new THREE.Vector3(...data.middle), 0.8 * data.size);
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
