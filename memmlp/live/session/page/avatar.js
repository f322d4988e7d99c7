// A VRM avatar that stands as the prediction does, at the wearer's size, by three-vrm.

import { Quaternion } from 'three';
import { GLTFLoader } from './npm/examples/jsm/loaders/GLTFLoader.js';
import { VRMLoaderPlugin, VRMUtils } from './npm/lib/three-vrm.module.min.js';

export class Avatar {
  static async load(url, description) {
    const loader = new GLTFLoader();
    loader.register(parser => new VRMLoaderPlugin(parser));
    const { vrm } = (await loader.loadAsync(url)).userData;
    if (!vrm) throw new Error('no VRM avatar in the file');
    return new Avatar(vrm, description);
  }

  // description: bones by joint, their parents, and the unit of quaternions.
  constructor(vrm, description) {
    Object.assign(this, description, { vrm, scene: vrm.scene });
    this.nodes = description.bones.map(name => vrm.humanoid.getNormalizedBoneNode(name));
    this.rest = this.nodes[0].position.y;
    this.mirrored = vrm.meta.metaVersion === '0'; // VRM 0.x faces -Z
    VRMUtils.rotateVRM0(vrm);
    this.scene.traverse(object => Object.assign(object, { frustumCulled: false, castShadow: Boolean(object.isMesh) }));
    this.missing = description.bones.map(() => new Quaternion());
    this.turned = new Quaternion();
    this.then = performance.now();
  }

  // turns: 22 quaternions xyzw as whole numbers; joints: 22 positions as 66 numbers; hips: the height of the wearer's; metres.
  pose(turns, joints, hips) {
    const size = hips / this.rest;
    const side = this.mirrored ? -1 : 1;
    this.scene.scale.setScalar(size);
    this.nodes.forEach((node, joint) => this.turn(node, joint, turns, side));
    this.nodes[0].position.set(side * joints[0], joints[1], side * joints[2]).divideScalar(size);
    const now = performance.now();
    this.vrm.update(Math.min((now - this.then) / 1000, 0.1)); // hair and clothes follow, too
    this.then = now;
  }

  // A bone that an avatar has not hands its rotation on to those below it.
  turn(node, joint, turns, side) {
    const [x, y, z, w] = [0, 1, 2, 3].map(i => turns[4 * joint + i] / this.unit);
    this.turned.set(side * x, y, side * z, w).normalize();
    const above = this.parents[joint];
    if (above >= 0 && !this.nodes[above]) this.turned.premultiply(this.missing[above]);
    if (node) node.quaternion.copy(this.turned);
    else this.missing[joint].copy(this.turned);
  }
}
