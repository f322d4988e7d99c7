// A headset in software (IWER), whose head and hands a test moves. It runs before the page's own scripts.

(() => {
  const device = new IWER.XRDevice(IWER.metaQuest3, { stereoEnabled: false });
  device.installRuntime({ forceInstall: true });
  const kept = { device, saved: null };
  const request = navigator.xr.requestSession.bind(navigator.xr);
  navigator.xr.requestSession = async (...words) => (kept.session = await request(...words));
  const address = URL.createObjectURL;
  URL.createObjectURL = blob => {
    blob.text().then(text => { kept.saved = text; });
    return address(blob);
  };

  // Where the grips are on the target rays, which are what IWER's controllers are placed by.
  kept.learn = () => new Promise(resolve => kept.session.requestAnimationFrame((_, frame) => {
    kept.grips = ['left', 'right'].map(side => {
      const source = [...kept.session.inputSources].find(({ handedness }) => handedness === side);
      return frame.getPose(source.gripSpace, source.targetRaySpace).transform.inverse;
    });
    resolve(kept.grips.length);
  }));

  // Put head and grips somewhere: [{ position, rotation }].
  kept.put = ([head, ...hands]) => {
    place(device, new XRRigidTransform(point(head.position), point(head.rotation)));
    hands.forEach((hand, i) => {
      const grip = new DOMMatrix(new XRRigidTransform(point(hand.position), point(hand.rotation)).matrix);
      const ray = grip.multiply(new DOMMatrix(kept.grips[i].matrix));
      place(device.controllers[['left', 'right'][i]], decomposed(ray));
    });
  };

  function point([x, y, z, w = 1]) { return new DOMPointReadOnly(x, y, z, w); }

  function place(thing, { position: p, orientation: q }) {
    thing.position.set(p.x, p.y, p.z);
    thing.quaternion.set(q.x, q.y, q.z, q.w);
  }

  function decomposed(m) {
    const w = Math.sqrt(Math.max(0, 1 + m.m11 + m.m22 + m.m33)) / 2;
    const part = (a, b, c) => Math.sign(c || 1) * Math.sqrt(Math.max(0, 1 + a - b)) / 2;
    const q = {
      x: part(m.m11, m.m22 + m.m33, m.m23 - m.m32), y: part(m.m22, m.m11 + m.m33, m.m31 - m.m13),
      z: part(m.m33, m.m11 + m.m22, m.m12 - m.m21), w,
    };
    const norm = Math.hypot(q.x, q.y, q.z, q.w);
    for (const key of Object.keys(q)) q[key] /= norm;
    return { position: { x: m.m41, y: m.m42, z: m.m43 }, orientation: q };
  }

  // Play frames of trackers (joints) at 60 Hz with devices that sit on the body as `offsets` say; resolves at the end.
  // A slow machine gets the clip slower: at least every fourth frame is drawn. The last one is kept until `over()` holds.
  kept.play = async (frames, offsets, over = () => true) => {
    const { inverse, minus, multiply, rotate } = await import('./rotations.js');
    const worn = trackers => trackers.map(({ position, rotation }, i) => {
      const turned = multiply(rotation, inverse(offsets.rotations[i]));
      return { position: minus(position, rotate(turned, offsets.positions[i])), rotation: turned };
    });
    const began = performance.now();
    for (let frame = 0; ;) {
      frame = Math.min(Math.floor((performance.now() - began) * 0.06), frame + 4);
      if (frame >= frames.length && over()) return frames.length;
      kept.put(worn(frames[Math.min(frame, frames.length - 1)]));
      await new Promise(resolve => kept.session.requestAnimationFrame(resolve));
    }
  };

  kept.pull = () => {
    device.controllers.right.updateButtonValue('trigger', 1);
    setTimeout(() => device.controllers.right.updateButtonValue('trigger', 0), 100);
  };
  window.headset = kept;
})();
