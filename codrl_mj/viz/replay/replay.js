"use strict";
/* Shows a motion in 3D: codrlReplay(element) reads the data within the element and returns setTime(seconds).
   Between recorded instants positions and rotations are interpolated. */
function codrlReplay(element) {
  const box = element.querySelector(".replay"), canvas = box.querySelector("canvas");
  const data = JSON.parse(box.querySelector("script").textContent);
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  const times = new Float32Array(bytes(data.time)), poses = new Float32Array(bytes(data.poses));
  const count = data.bodies.length;
  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
  } catch {
    canvas.hidden = true;
    box.querySelector(".replay-view").hidden = true;
    box.querySelector(".replay-none").hidden = false;
    return () => {};
  }
  renderer.shadowMap.enabled = true;

  /* -- the scene --------------------------------------------------------------------------------------------- */

  const scene = new THREE.Scene(), extent = data.extent;
  const placed = (object, at) => {
    object.position.set(at[0], at[1], at[2]);
    object.quaternion.set(at[4], at[5], at[6], at[3]).normalize();
    return object;
  };
  const meshes = data.meshes.map((mesh) => {
    const grid = new Uint16Array(bytes(mesh.vertices)), corners = bytes(mesh.triangles);
    const vertices = Float32Array.from(grid, (value, place) => mesh.low[place % 3] + (value / 65535) * mesh.span);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(vertices, 3));
    geometry.setIndex(new THREE.BufferAttribute(mesh.wide ? new Uint32Array(corners) : new Uint16Array(corners), 1));
    return THREE.toCreasedNormals(geometry, 0.6);
  });
  const along = (geometry) => geometry.rotateX(Math.PI / 2); // the axis of a cylinder is y in three.js, z in MuJoCo
  const wide = (half) => (half > 0 ? 2 * half : 40 * extent); // size 0 means infinite in MuJoCo
  const geometries = {
    plane: ([x, y]) => new THREE.PlaneGeometry(wide(x), wide(y)),
    ellipsoid: (size) => new THREE.SphereGeometry(1, 40, 24).scale(...size),
    capsule: ([radius, half]) => along(new THREE.CapsuleGeometry(radius, 2 * half, 12, 32)),
    cylinder: ([radius, half]) => along(new THREE.CylinderGeometry(radius, radius, 2 * half, 48)),
    box: (size) => new THREE.BoxGeometry(...size.map((half) => 2 * half)),
  };
  const squares = (size) => {
    const texture = new THREE.DataTexture(new Uint8Array([255, 255, 255, 255, 218, 218, 218, 255,
      218, 218, 218, 255, 255, 255, 255, 255]), 2, 2);
    texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
    texture.repeat.set(wide(size[0]) / extent, wide(size[1]) / extent);
    texture.colorSpace = THREE.SRGBColorSpace;
    texture.needsUpdate = true;
    return texture;
  };
  const groups = data.bodies.map(() => scene.add(new THREE.Group()).children.at(-1));
  for (const shape of data.shapes) {
    const [red, green, blue, opacity] = shape.colour;
    const material = new THREE.MeshStandardMaterial({ roughness: 0.65, metalness: 0.05 });
    material.color.setRGB(red, green, blue, THREE.SRGBColorSpace);
    if (opacity < 1) Object.assign(material, { transparent: true, opacity, depthWrite: false });
    if (shape.kind === "plane" && shape.chequered) material.map = squares(shape.size);
    if (shape.kind === "mesh") material.side = THREE.DoubleSide;
    const geometry = shape.kind === "mesh" ? meshes[shape.mesh] : geometries[shape.kind](shape.size);
    const object = placed(new THREE.Mesh(geometry, material), shape.at);
    object.castShadow = shape.kind !== "plane" && opacity === 1;
    object.receiveShadow = true;
    if (shape.body === undefined) scene.add(placed(new THREE.Group(), shape.frame).add(object));
    else groups[shape.body].add(object);
  }
  scene.add(new THREE.HemisphereLight(0xffffff, 0xc4c4c4, 2.9));
  const lamp = new THREE.DirectionalLight(0xffffff, 1.8), reach = 2 * extent;
  lamp.castShadow = true;
  lamp.shadow.mapSize.set(2048, 2048);
  lamp.shadow.normalBias = 0.01 * extent;
  Object.assign(lamp.shadow.camera, { left: -reach, right: reach, top: reach, bottom: -reach, near: 0.01 * extent,
    far: 12 * extent });
  scene.add(lamp, lamp.target);

  /* -- the camera --------------------------------------------------------------------------------------------- */

  const camera = new THREE.PerspectiveCamera(data.camera.fovy, 1, 0.005 * extent, 100 * extent);
  camera.up.set(0, 0, 1);
  const controls = new THREE.OrbitControls(camera, canvas);
  const shift = new THREE.Vector3(); // displacement of the followed body since the start
  const towards = new THREE.Vector3(-0.35, -0.7, 1).normalize().multiplyScalar(4 * extent);
  function resetView() {
    camera.position.set(...data.camera.eye).add(shift);
    controls.target.set(...data.camera.at).add(shift);
    controls.update();
    draw();
  }
  const followed = 0; // the first body that moves, a robot's root
  const path = (axis) => Array.from(times, (_, index) => poses[(index * count + followed) * 7 + axis]);
  const strays = count > 0 && [0, 1, 2].some((axis) => Math.max(...path(axis)) - Math.min(...path(axis)) > extent);
  let follows = false;
  const button = box.querySelector('[data-do="follow"]');
  function follow(on) {
    follows = on && count > 0;
    button.setAttribute("aria-pressed", String(follows));
    show();
  }

  /* -- an instant --------------------------------------------------------------------------------------------- */

  let now = 0;
  const after = new THREE.Quaternion();
  function show() {
    let low = 0, high = times.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= now) low = middle; else high = middle;
    }
    const part = high > low ? Math.min(Math.max((now - times[low]) / (times[high] - times[low]), 0), 1) : 0;
    groups.forEach((group, body) => {
      const one = poses.subarray((low * count + body) * 7), other = poses.subarray((high * count + body) * 7);
      group.position.set(...[0, 1, 2].map((axis) => one[axis] + part * (other[axis] - one[axis])));
      group.quaternion.set(one[4], one[5], one[6], one[3]).normalize();
      group.quaternion.slerp(after.set(other[4], other[5], other[6], other[3]).normalize(), part);
    });
    const moved = new THREE.Vector3();
    if (follows) {
      moved.copy(groups[followed].position);
      moved.x -= poses[followed * 7];
      moved.y -= poses[followed * 7 + 1];
      moved.z = 0;
    }
    const step = moved.clone().sub(shift);
    shift.copy(moved);
    camera.position.add(step);
    controls.target.add(step);
    lamp.target.position.set(...data.camera.at).add(shift);
    lamp.position.copy(lamp.target.position).add(towards);
    draw();
  }
  let waiting = false;
  function draw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      renderer.render(scene, camera);
    });
  }
  function resize() {
    const { clientWidth: width, clientHeight: height } = box;
    if (!width || !height) return;
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    // In a narrow frame a larger angle keeps the sides visible.
    camera.fov = camera.aspect >= 4 / 3 ? data.camera.fovy
      : 2 * Math.atan((Math.tan((data.camera.fovy * Math.PI) / 360) * 4) / 3 / camera.aspect) * (180 / Math.PI);
    camera.updateProjectionMatrix();
    draw();
  }
  const deeds = { reset: resetView, follow: () => follow(!follows) };
  for (const each of box.querySelectorAll("[data-do]")) each.addEventListener("click", () => deeds[each.dataset.do]());
  canvas.addEventListener("keydown", (event) => {
    const turn = { a: [-1, 0], d: [1, 0], w: [0, -1], s: [0, 1] }[event.key.toLowerCase()];
    const deed = { r: "reset", f: "follow" }[event.key.toLowerCase()];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (deed) deeds[deed]();
    if (turn) {
      controls.rotateLeft?.(turn[0] * 0.1);
      controls.rotateUp?.(turn[1] * 0.1);
      controls.update();
    }
  });
  controls.addEventListener("change", draw);
  new ResizeObserver(resize).observe(box);
  resetView();
  follow(strays);
  resize();
  box.replay = { controls, camera, groups };
  return (seconds) => {
    now = seconds;
    show();
  };
}
