// The scene in VR: the wearer's body, without its head, a mirror that shows all of it, and a board above it.

import * as THREE from 'three';
import { Limb } from './stage.js';

const AWAY = 1.3; // metres from the wearer to the mirror
const [WIDTH, HEIGHT] = [1.3, 2.1]; // metres of the mirror
const FEW = [12, 1]; // sides and rings of a limb: it has one colour, and is drawn for two eyes and a mirror
const SKIN = 0x27a9e1;
const PANEL = [1024, 256]; // pixels of the board
const FACE = ['#14191f', '#e3e8ee'];

export class WornScene {
  // joints: names of the joints; limbs: how they are shown (site.json).
  constructor(canvas, { limbs, joints }) {
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.renderer.xr.enabled = true;
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(60, 1, 0.05, 60);
    this.camera.position.set(0, 1.55, 0);
    const material = new THREE.MeshStandardMaterial({ color: SKIN, roughness: 0.7, vertexColors: false });
    this.limbs = limbs.map(limb => new Limb(limb, material, 1, ...FEW));
    const skull = joints.flatMap((name, i) => (/head|neck/.test(name) ? [i] : []));
    this.own = new THREE.Group();
    this.own.add(...this.limbs.filter((_, i) => !skull.includes(limbs[i].end)).map(limb => limb.mesh));
    this.image = new THREE.Group();
    this.shown = this.limbs.map(limb => new THREE.Mesh(limb.geometry, material));
    for (const mesh of this.shown) mesh.frustumCulled = false;
    this.image.add(...this.shown);
    this.image.matrixAutoUpdate = false;
    this.place = new THREE.Group();
    this.place.add(frame(), this.panel());
    this.room();
    this.scene.add(this.own, this.image, this.place);
    this.visible(false);
    this.stand([0, 1.5, 0], 0);
  }

  room() {
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8a94a0, 2));
    const sun = new THREE.DirectionalLight(0xffffff, 1.8);
    sun.position.set(1.4, 4, 1.8);
    this.floor = new THREE.GridHelper(8, 16, 0x6b7683, 0x6b7683);
    this.ground = new THREE.Mesh(new THREE.CircleGeometry(12, 48), new THREE.MeshBasicMaterial({ color: 0xd9dee3, depthWrite: false }));
    this.ground.rotation.x = -Math.PI / 2;
    this.ground.renderOrder = -1; // before the lines on it, which are as far away
    this.sky = new THREE.Color(0xeef1f4);
    this.scene.add(sun, this.floor, this.ground);
    this.through(false);
  }

  // Show the real room (AR), or a virtual one.
  through(real) {
    this.scene.background = real ? null : this.sky;
    this.floor.visible = this.ground.visible = !real;
  }

  panel() {
    this.boardCanvas = document.createElement('canvas');
    [this.boardCanvas.width, this.boardCanvas.height] = PANEL;
    this.texture = new THREE.CanvasTexture(this.boardCanvas);
    this.texture.colorSpace = THREE.SRGBColorSpace;
    const mesh = new THREE.Mesh(new THREE.PlaneGeometry(WIDTH, WIDTH / 4), new THREE.MeshBasicMaterial({ map: this.texture }));
    mesh.position.set(0, HEIGHT + 0.25, 0);
    return mesh;
  }

  // Write lines on the board above the mirror.
  write(...lines) {
    if (this.board === lines.join('\n')) return;
    this.board = lines.join('\n');
    const pen = this.boardCanvas.getContext('2d');
    [pen.fillStyle, pen.font, pen.textAlign, pen.textBaseline] = [FACE[0], '52px system-ui, sans-serif', 'center', 'middle'];
    pen.fillRect(0, 0, ...PANEL);
    pen.fillStyle = FACE[1];
    lines.forEach((line, i) => pen.fillText(line, PANEL[0] / 2, PANEL[1] * ((i + 1) / (lines.length + 1)), PANEL[0] - 60));
    this.texture.needsUpdate = true;
  }

  // Put the mirror in front of a head that looks somewhere (radians to the left of -Z).
  stand([x, , z], heading) {
    const forward = new THREE.Vector3(-Math.sin(heading), 0, -Math.cos(heading));
    this.place.position.set(x, 0, z).addScaledVector(forward, AWAY);
    this.place.rotation.y = heading;
    this.place.updateMatrix();
    const flip = new THREE.Matrix4().makeScale(1, 1, -1);
    this.image.matrix.copy(this.place.matrix).multiply(flip).multiply(this.place.matrix.clone().invert());
    this.image.matrixWorldNeedsUpdate = true;
  }

  // joints: 22 positions as 66 numbers, metres.
  show(joints) {
    this.visible(true);
    this.limbs.forEach((limb, i) => {
      limb.place(joints);
      this.shown[i].position.copy(limb.mesh.position);
      this.shown[i].quaternion.copy(limb.mesh.quaternion);
    });
  }

  visible(is) { this.own.visible = this.image.visible = is; }

  // Draw the scene for a session; canvas and camera are the session's then.
  draw() { this.renderer.render(this.scene, this.camera); }

  dispose() {
    this.renderer.setAnimationLoop(null);
    this.renderer.dispose();
  }
}

// The mirror's frame, and a film that makes the image behind it a little paler.
function frame() {
  const group = new THREE.Group();
  const wood = new THREE.MeshStandardMaterial({ color: 0x3a4550, roughness: 0.6 });
  const bar = (width, height, x, y) => {
    const mesh = new THREE.Mesh(new THREE.BoxGeometry(width, height, 0.04), wood);
    mesh.position.set(x, y, 0);
    group.add(mesh);
  };
  for (const side of [-1, 1]) bar(0.05, HEIGHT, (side * WIDTH) / 2, HEIGHT / 2);
  for (const height of [0.025, HEIGHT]) bar(WIDTH + 0.05, 0.05, 0, height);
  const film = new THREE.Mesh(new THREE.PlaneGeometry(WIDTH, HEIGHT), new THREE.MeshBasicMaterial({ color: 0xbfd4e6, transparent: true, opacity: 0.25, depthWrite: false }));
  film.position.y = HEIGHT / 2;
  group.add(film);
  return group;
}
