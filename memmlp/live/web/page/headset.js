// Head and hands of a WebXR frame, as a Stream takes them, and the typical offsets of joints on devices.

// Head and hands in a reference space: { position, rotation } each, or null where the device does not see it.
// Hands are controllers' grips, or wrists where the device tracks hands.
export function trackersOf(frame, space, sources) {
  const hand = side => {
    const source = sourceOf(side, sources);
    if (!source) return null;
    const pose = source.hand ? frame.getJointPose(source.hand.get('wrist'), space) : frame.getPose(source.gripSpace, space);
    return tracker(pose);
  };
  return [tracker(frame.getViewerPose(space)), hand('left'), hand('right')];
}

// "hands" or "controllers" for left and right, whose offsets differ, also on one headset; null for neither.
export const kindsOf = sources => ['left', 'right'].map(side => {
  const source = sourceOf(side, sources);
  return source && (source.hand ? 'hands' : 'controllers');
});

const sourceOf = (side, sources) =>
  [...sources].find(({ handedness, gripSpace, hand }) => handedness === side && (gripSpace || hand)) ?? null;

// null without a pose; a pose that the device only guesses is used.
function tracker(pose) {
  if (!pose) return null;
  const { position: p, orientation: q } = pose.transform;
  return { position: [p.x, p.y, p.z], rotation: [q.x, q.y, q.z, q.w] };
}

const HALF = Math.SQRT1_2;
const HEAD = { position: [0, -0.07, 0.09], rotation: [0, 0, 0, 1] }; // from between the eyes to the base of the skull
const SITS = {
  // A wrist's pose has -Z along the hand and +Y out of its back; in a T-pose with palms down -Z points to the side.
  hands: [
    { position: [0, 0, 0], rotation: [0, -HALF, 0, HALF] },
    { position: [0, 0, 0], rotation: [0, HALF, 0, HALF] },
  ],
  // A grip has -Z from the little finger to the thumb and X through the palm; the wrist is up its Y.
  controllers: [
    { position: [0, 0.09, 0], rotation: [0, 0, HALF, HALF] },
    { position: [0, 0.09, 0], rotation: [0, 0, -HALF, HALF] },
  ],
};

// The typical offsets of head and wrists on devices of these kinds, left and right, until a calibration.
export function usualOffsets(kinds) {
  const parts = [HEAD, ...kinds.map((kind, side) => SITS[kind ?? 'controllers'][side])];
  return { positions: parts.map(({ position }) => position), rotations: parts.map(({ rotation }) => rotation) };
}
