// A scene: a floor, the truth in grey, the prediction coloured by error, a camera that follows the person.

import * as THREE from 'three';
import { h } from './dom.js';
import { OrbitControls } from './three/OrbitControls.js';

const SIDES = 20; // of a limb
const RINGS = 6; // along a limb, so that its colour follows the scale
const UP = new THREE.Vector3(0, 1, 0);
const SUN = new THREE.Vector3(1.4, 4, 1.8); // from the person's middle to the light
const START = new THREE.Vector3(1.1, 0.5, 3.2); // from the person's middle to the camera, at first

export class Stage {
  constructor(canvas, { limbs, heat, top }) {
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
    this.renderer.shadowMap.enabled = true;
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(35, 1, 0.1, 60);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.maxPolarAngle = 0.53 * Math.PI;
    this.controls.minDistance = 0.8;
    this.controls.maxDistance = 12;
    this.heat = heatmap(heat, top);
    this.prediction = new Body(limbs, 1, 1);
    this.truth = new Body(limbs, 0.55, 0.8);
    this.scene.add(this.prediction.group, this.truth.group);
    this.light();
    this.applyTheme();
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.applyTheme());
  }

  light() {
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8a94a0, 1.9));
    this.sun = new THREE.DirectionalLight(0xffffff, 2.2);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    this.sun.shadow.radius = 6;
    Object.assign(this.sun.shadow.camera, { left: -2, right: 2, top: 2, bottom: -2, near: 0.5, far: 9 });
    this.floor = new THREE.Mesh(new THREE.CircleGeometry(14, 64), new THREE.ShadowMaterial({ opacity: 0.22 }));
    this.floor.rotation.x = -Math.PI / 2;
    this.floor.receiveShadow = true;
    this.scene.add(this.sun, this.sun.target, this.floor);
  }

  // Use the page's colours, light or dark.
  applyTheme() {
    const style = getComputedStyle(document.documentElement);
    const colour = name => new THREE.Color(style.getPropertyValue(name).trim());
    this.scene.background = colour('--stage');
    this.scene.fog = new THREE.Fog(this.scene.background, 4, 8);
    this.scene.remove(this.grid);
    this.grid = new THREE.GridHelper(6, 12, colour('--grid'), colour('--grid'));
    this.scene.add(this.grid);
    this.grey = colour('--truth');
  }

  show(frame) {
    const { positions, truth, errors } = frame;
    this.prediction.group.visible = !this.avatar;
    this.truth.group.visible = errors !== null && !this.avatar;
    if (this.avatar) this.avatar.pose(frame.turns, positions, frame.hips);
    else this.prediction.pose(positions, errors ? this.heat.bind(null, errors) : () => this.grey);
    if (this.truth.group.visible) this.truth.pose(truth, () => this.grey);
    this.follow(truth ?? positions);
  }

  // Move camera and light with the person's middle, smoothly except for a jump of a metre.
  follow(joints) {
    const lowest = Math.min(...joints.filter((_, i) => i % 3 === 1));
    this.ground = Math.min(lowest, this.ground ?? lowest);
    const target = this.controls.target;
    const moved = new THREE.Vector3(joints[0], this.ground + 0.88, joints[2]).sub(target);
    const now = performance.now();
    if (this.met && moved.length() < 1) moved.multiplyScalar(1 - Math.exp(-(now - this.met) / 250));
    target.add(moved);
    this.camera.position.add(this.met ? moved : target.clone().add(this.front(joints)));
    this.met = now;
    this.sun.target.position.copy(target);
    this.sun.position.copy(target).add(SUN);
    this.floor.position.set(target.x, this.ground - 0.03, target.z);
    this.grid.position.set(Math.round(2 * target.x) / 2, this.ground - 0.03, Math.round(2 * target.z) / 2);
  }

  // The camera's place from the person's middle, to see the person from the front and a little from the side.
  front(joints) {
    const left = new THREE.Vector3(joints[3] - joints[6], 0, joints[5] - joints[8]); // from right to left hip
    return START.clone().applyAxisAngle(UP, Math.atan2(-left.z, left.x));
  }

  // Draw the scene with the camera of a leading stage.
  draw(leader) {
    this.controls.target.copy(leader.controls.target);
    this.camera.position.copy(leader.camera.position);
    const { clientWidth: width, clientHeight: height } = this.renderer.domElement.parentElement;
    const ratio = Math.min(devicePixelRatio, 2);
    if (this.width !== width || this.height !== height || this.ratio !== ratio) {
      Object.assign(this, { width, height, ratio });
      this.renderer.setPixelRatio(ratio);
      this.renderer.setSize(width, height, false);
      this.camera.aspect = width / Math.max(height, 1);
      this.camera.updateProjectionMatrix();
    }
    this.controls.update();
    this.renderer.render(this.scene, this.camera);
  }
}

// A person of round limbs. A slim person hides inside another with the same pose.
class Body {
  constructor(limbs, opacity, slim) {
    const material = new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 0.75, transparent: opacity < 1, opacity, depthWrite: opacity === 1 });
    this.limbs = limbs.map(limb => new Limb(limb, material, slim));
    this.group = new THREE.Group().add(...this.limbs.map(limb => limb.mesh));
  }

  // joints: 66 numbers, metres; paint: (joint, other joint, part of the way) -> a colour.
  pose(joints, paint) {
    for (const limb of this.limbs) {
      limb.place(joints);
      limb.colour(paint);
    }
  }
}

// A round limb: a surface of revolution with a half sphere at each end. One morph target moves one half away from the other.
export class Limb {
  constructor({ start, end, radii, tip }, material, slim, sides = SIDES, rings = RINGS) {
    Object.assign(this, { start, end, tip });
    const profile = outline(...radii.map(radius => slim * radius), rings);
    this.parts = profile.map(({ part }) => part);
    const geometry = new THREE.LatheGeometry(profile.map(({ x, y, part }) => new THREE.Vector2(x, y + part)), sides);
    const { count } = geometry.attributes.position;
    const shift = Array.from({ length: count }, (_, vertex) => [0, this.parts[vertex % this.parts.length], 0]);
    geometry.morphAttributes.position = [new THREE.Float32BufferAttribute(shift.flat(), 3)];
    geometry.morphTargetsRelative = true;
    geometry.setAttribute('color', new THREE.Float32BufferAttribute(new Float32Array(3 * count), 3));
    this.mesh = new THREE.Mesh(geometry, material);
    this.mesh.castShadow = slim === 1;
    this.mesh.frustumCulled = false;
  }

  place(joints) {
    const at = joint => new THREE.Vector3().fromArray(joints, 3 * joint);
    let [from, to] = [at(this.start), at(this.end)];
    const along = to.clone().sub(from).normalize();
    if (this.tip) [from, to] = [to, to.clone().addScaledVector(along, this.tip)];
    this.mesh.position.copy(from);
    this.mesh.quaternion.setFromUnitVectors(UP, along);
    this.mesh.morphTargetInfluences[0] = from.distanceTo(to) - 1; // the geometry is 1 m long
  }

  colour(paint) {
    const colours = this.mesh.geometry.attributes.color;
    const row = this.parts.map(part => paint(this.tip ? this.end : this.start, this.end, part));
    for (let vertex = 0; vertex < colours.count; vertex++) colours.setXYZ(vertex, ...row[vertex % row.length]);
    colours.needsUpdate = true;
  }
}

// The limb's outline from end to end: at radius x, y above the point that is `part` of the way along.
function outline(start, end, count) {
  const quarter = Array.from({ length: 7 }, (_, i) => (Math.PI / 12) * i);
  const cap = (radius, side, part) =>
    quarter.map(angle => ({ x: radius * Math.sin(angle), y: side * radius * Math.cos(angle), part }));
  const rings = Array.from({ length: count - 1 }, (_, i) => (i + 1) / count);
  const between = rings.map(part => ({ x: start + part * (end - start), y: 0, part }));
  return [...cap(start, -1, 0), ...between, ...cap(end, 1, 1).reverse()];
}

// Returns (errors, joint, other joint, part of the way) -> the colour of the error there.
function heatmap(colours, top) {
  const anchors = colours.map(colour => new THREE.Color(colour));
  return (errors, a, b, part) => {
    const error = errors[a] + part * (errors[b] - errors[a]);
    const place = Math.min(Math.max(error / top, 0), 1) * (anchors.length - 1);
    const below = Math.min(Math.floor(place), anchors.length - 2);
    return anchors[below].clone().lerp(anchors[below + 1], place - below);
  };
}

// A frame in metres, with the joints' errors and their mean, cm, if the truth is known.
export function measureErrors(frame) {
  const positions = metres(frame.positions);
  if (!frame.truth) return { ...frame, positions, truth: null, errors: null, mean: null };
  const truth = metres(frame.truth);
  const errors = Float32Array.from({ length: positions.length / 3 }, (_, joint) =>
    100 * Math.hypot(...[0, 1, 2].map(i => positions[3 * joint + i] - truth[3 * joint + i])));
  return { ...frame, positions, truth, errors, mean: errors.reduce((a, b) => a + b) / errors.length };
}

const metres = millimetres => Float32Array.from(millimetres, mm => mm / 1000);

export function colourScale(heat, top) {
  return ['0', h('i', { style: `background: linear-gradient(to right, ${heat.join(', ')})` }), `${top}+ cm`];
}
