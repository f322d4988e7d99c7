// The scene in VR: the user's body without its head, a mirror that shows all of it, and a board above the mirror.

import * as THREE from 'three';
import { Limb } from './stage.js';

const DISTANCE = 1.3; // metres from the user to the mirror
const [WIDTH, HEIGHT] = [1.3, 2.1]; // metres of the mirror
const DETAIL = [12, 1]; // sides and rings of a limb: it has one colour, and is drawn for two eyes and a mirror
const BOARD = [1024, 256]; // pixels

export class MirrorScene {
  // joints: names of the joints; limbs: their shapes (site.json).
  constructor(canvas, { limbs, joints }) {
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.renderer.xr.enabled = true;
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(60, 1, 0.05, 60);
    this.camera.position.set(0, 1.55, 0);
    this.makeBodies(limbs, joints);
    this.mirror = new THREE.Group().add(makeFrame(), this.makeBoard());
    this.scene.add(this.body, this.image, this.mirror);
    this.makeRoom();
    this.hideBody();
    this.stand([0, 1.5, 0], 0);
  }

  // The user's limbs except the head, and the mirror image of all limbs, which shares their geometry.
  makeBodies(limbs, joints) {
    const material = new THREE.MeshStandardMaterial({ color: 0x27a9e1, roughness: 0.7 });
    this.limbs = limbs.map(limb => new Limb(limb, material, 1, ...DETAIL));
    this.body = new THREE.Group().add(...this.limbs.filter(({ end }) => !/head|neck/.test(joints[end])).map(({ mesh }) => mesh));
    this.image = new THREE.Group().add(...this.limbs.map(({ mesh }) => mesh.clone()));
    this.image.matrixAutoUpdate = false;
  }

  makeRoom() {
    const sun = new THREE.DirectionalLight(0xffffff, 1.8);
    sun.position.set(1.4, 4, 1.8);
    const ground = new THREE.Mesh(new THREE.CircleGeometry(12, 48), new THREE.MeshBasicMaterial({ color: 0xd9dee3, depthWrite: false }));
    ground.rotation.x = -Math.PI / 2;
    ground.renderOrder = -1; // before the lines on it, which are at the same depth
    this.room = new THREE.Group().add(ground, new THREE.GridHelper(8, 16, 0x6b7683, 0x6b7683));
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8a94a0, 2), sun, this.room);
  }

  // Show the real room (AR), or a virtual one.
  showRoom(real) {
    this.scene.background = real ? null : new THREE.Color(0xeef1f4);
    this.room.visible = !real;
  }

  makeBoard() {
    const canvas = document.createElement('canvas');
    [canvas.width, canvas.height] = BOARD;
    this.pen = canvas.getContext('2d');
    this.texture = new THREE.CanvasTexture(canvas);
    this.texture.colorSpace = THREE.SRGBColorSpace;
    const board = new THREE.Mesh(new THREE.PlaneGeometry(WIDTH, WIDTH / 4), new THREE.MeshBasicMaterial({ map: this.texture }));
    board.position.y = HEIGHT + 0.25;
    return board;
  }

  // Write lines on the board.
  write(...lines) {
    if (this.text === lines.join('\n')) return;
    this.text = lines.join('\n');
    const [width, height] = BOARD;
    Object.assign(this.pen, { fillStyle: '#14191f', font: '52px system-ui, sans-serif', textAlign: 'center', textBaseline: 'middle' });
    this.pen.fillRect(0, 0, width, height);
    this.pen.fillStyle = '#e3e8ee';
    lines.forEach((line, i) => this.pen.fillText(line, width / 2, height * ((i + 1) / (lines.length + 1)), width - 60));
    this.texture.needsUpdate = true;
  }

  // Put the mirror in front of a head at a position with a heading, radians to the left of -Z.
  stand([x, , z], heading) {
    this.mirror.position.set(x - DISTANCE * Math.sin(heading), 0, z - DISTANCE * Math.cos(heading));
    this.mirror.rotation.y = heading;
    this.mirror.updateMatrix();
    const { matrix } = this.mirror;
    this.image.matrix.makeScale(1, 1, -1).premultiply(matrix).multiply(matrix.clone().invert());
    this.image.matrixWorldNeedsUpdate = true;
  }

  // joints: 22 positions as 66 numbers, metres.
  show(joints) {
    this.body.visible = this.image.visible = true;
    this.limbs.forEach((limb, i) => {
      limb.place(joints);
      const { position, quaternion, morphTargetInfluences } = limb.mesh;
      Object.assign(this.image.children[i], { morphTargetInfluences });
      this.image.children[i].position.copy(position);
      this.image.children[i].quaternion.copy(quaternion);
    });
  }

  hideBody() {
    this.body.visible = this.image.visible = false;
    this.showRoom(false);
  }
}

// The mirror's frame, and a film that makes the image behind it a little paler.
function makeFrame() {
  const film = new THREE.MeshBasicMaterial({ color: 0xbfd4e6, transparent: true, opacity: 0.25, depthWrite: false });
  const wood = new THREE.MeshStandardMaterial({ color: 0x3a4550, roughness: 0.6 });
  const bar = (x, y, width, height) => new THREE.Mesh(new THREE.BoxGeometry(width, height, 0.04).translate(x, y, 0), wood);
  const [side, middle] = [WIDTH / 2 + 0.025, HEIGHT / 2];
  return new THREE.Group().add(new THREE.Mesh(new THREE.PlaneGeometry(WIDTH, HEIGHT).translate(0, middle, 0), film),
    bar(-side, middle, 0.05, HEIGHT), bar(side, middle, 0.05, HEIGHT), bar(0, -0.025, WIDTH + 0.1, 0.05), bar(0, HEIGHT + 0.025, WIDTH + 0.1, 0.05));
}
