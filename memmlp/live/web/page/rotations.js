// Rotations as unit quaternions [x, y, z, w], vectors as [x, y, z]; Y is up. As memmlp.live.rotations, in float64.

export const IDENTITY = [0, 0, 0, 1];

export const plus = (a, b, share = 1) => a.map((value, i) => value + share * b[i]);
export const minus = (a, b) => a.map((value, i) => value - b[i]);

export function multiply([a, b, c, d], [e, f, g, h]) {
  return [
    d * e + a * h + b * g - c * f,
    d * f - a * g + b * h + c * e,
    d * g + a * f - b * e + c * h,
    d * h - a * e - b * f - c * g,
  ];
}

export const inverse = ([x, y, z, w]) => [-x, -y, -z, w];

export function rotate(quaternion, vector) {
  const [x, y, z] = multiply(multiply(quaternion, [...vector, 0]), inverse(quaternion));
  return [x, y, z];
}

// The rotation about the same axis by a share of its angle, which is taken from 0 to pi.
export function turnedBy(quaternion, share) {
  const sign = quaternion[3] < 0 ? -1 : 1;
  const [x, y, z, w] = quaternion.map(part => sign * part);
  const sine = Math.hypot(x, y, z);
  const half = share * Math.atan2(sine, w);
  const scale = sine > 1e-9 ? Math.sin(half) / sine : share;
  return [scale * x, scale * y, scale * z, Math.cos(half)];
}

// On the shortest way from a (weight 0) to b (weight 1).
export const slerp = (a, b, weight) => multiply(a, turnedBy(multiply(inverse(a), b), weight));

// The rotation about the vertical by an angle, radians.
export const aboutVertical = angle => [0, Math.sin(angle / 2), 0, Math.cos(angle / 2)];

// The twist about the vertical, radians, so that looking up or down does not matter.
export const headingOf = ([, y, , w]) => 2 * Math.atan2(y, w);

// The nine numbers of the rotation's matrix, row by row.
export function matrix([x, y, z, w]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
    2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
    2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
  ];
}
