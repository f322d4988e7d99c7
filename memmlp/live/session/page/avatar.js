// A VRM avatar in the pose and size of the prediction, by three-vrm.

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

  // description: bones by joint, the joints' parents, and the unit of quaternions.
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

  // turns: 22 quaternions xyzw as integers; joints: 66 numbers; hips: their height in the rest pose; metres.
  pose(turns, joints, hips) {
    const size = hips / this.rest;
    const side = this.mirrored ? -1 : 1;
    this.scene.scale.setScalar(size);
    this.nodes.forEach((node, joint) => this.turn(node, joint, turns, side));
    this.nodes[0].position.set(side * joints[0], joints[1], side * joints[2]).divideScalar(size);
    const now = performance.now();
    this.vrm.update(Math.min((now - this.then) / 1000, 0.1)); // also moves hair and clothes
    this.then = now;
  }

  // The rotation of a bone that the avatar lacks is added to the bones below it.
  turn(node, joint, turns, side) {
    const [x, y, z, w] = [0, 1, 2, 3].map(i => turns[4 * joint + i] / this.unit);
    this.turned.set(side * x, y, side * z, w).normalize();
    const above = this.parents[joint];
    if (above >= 0 && !this.nodes[above]) this.turned.premultiply(this.missing[above]);
    if (node) node.quaternion.copy(this.turned);
    else this.missing[joint].copy(this.turned);
  }
}
