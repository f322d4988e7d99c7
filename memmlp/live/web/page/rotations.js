// Rotations as unit quaternions [x, y, z, w], vectors as [x, y, z]; Y is up. As in memmlp.live.rotations, in float64.

import { Matrix3, Matrix4, Quaternion, Vector3 } from './three/three.core.min.js';

export const IDENTITY = [0, 0, 0, 1];

export const plus = (a, b, share = 1) => a.map((value, i) => value + share * b[i]);
export const minus = (a, b) => plus(a, b, -1);

export const multiply = (a, b) => new Quaternion(...a).multiply(new Quaternion(...b)).toArray();
export const inverse = ([x, y, z, w]) => [-x, -y, -z, w];
export const rotate = (rotation, vector) => new Vector3(...vector).applyQuaternion(new Quaternion(...rotation)).toArray();

// On the shortest way from a (weight 0) to b (weight 1).
export const slerp = (a, b, weight) => new Quaternion(...a).slerp(new Quaternion(...b), weight).toArray();

// The rotation about the vertical by an angle, radians.
export const aboutVertical = angle => [0, Math.sin(angle / 2), 0, Math.cos(angle / 2)];

// The twist about the vertical, radians, which does not depend on looking up or down.
export const headingOf = ([, y, , w]) => 2 * Math.atan2(y, w);

// The nine numbers of the rotation's matrix, row by row.
export function matrix(rotation) {
  const columns = new Matrix4().makeRotationFromQuaternion(new Quaternion(...rotation));
  return new Matrix3().setFromMatrix4(columns).transpose().toArray();
}
