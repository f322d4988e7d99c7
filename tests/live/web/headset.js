// A headset in software (IWER), whose head and hands a test moves. It runs before the page's own scripts.

(() => {
  let awaited = 0; // answers of the page's worker
  const post = Worker.prototype.postMessage;
  Worker.prototype.postMessage = function (...words) {
    if (!this.heard) this.heard = this.addEventListener('message', () => { awaited--; }) ?? true;
    awaited++;
    return post.apply(this, words);
  };

  // Software takes longer to draw a frame than the page to compute it: the display shows one in ten, and while
  // it is worn, frames need not wait for other work.
  let frames = 0;
  for (const kind of ['drawElements', 'drawArrays']) {
    const draw = WebGL2RenderingContext.prototype[kind];
    WebGL2RenderingContext.prototype[kind] = function (...words) {
      if (!kept.session || frames % 10 === 0) draw.apply(this, words);
    };
  }

  const device = new IWER.XRDevice(IWER.metaQuest3, { stereoEnabled: false });
  device.installRuntime({ forceInstall: true });
  const kept = { device };
  const request = navigator.xr.requestSession.bind(navigator.xr);
  navigator.xr.requestSession = async (...words) => {
    kept.session = patient(await request(...words));
    const before = window.seldom;
    window.seldom = 20;
    kept.session.addEventListener('end', () => { window.seldom = before; });
    return kept.session;
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

  const drawn = () => new Promise(resolve => kept.session.requestAnimationFrame(resolve));

  // Play frames of trackers (joints) at 60 Hz with devices that sit on the body as `offsets` say; resolves at the end.
  // The last frame is kept until `over()` holds.
  kept.play = async (frames, offsets, over = () => true) => {
    const { inverse, minus, multiply, rotate } = await import('./rotations.js');
    const worn = trackers => trackers.map(({ position, rotation }, i) => {
      const turned = multiply(rotation, inverse(offsets.rotations[i]));
      return { position: minus(position, rotate(turned, offsets.positions[i])), rotation: turned };
    });
    const began = await drawn();
    for (let now = began; ; now = await drawn()) {
      const frame = Math.floor((now - began) * 0.06);
      if (frame >= frames.length && over()) return frames.length;
      kept.put(worn(frames[Math.min(frame, frames.length - 1)]));
    }
  };

  // A display that shows 25 frames a second of its own time, each when the page's network is done with those before it:
  // what a session shows does not follow from how quick the machine is.
  function patient(session) {
    const display = session.requestAnimationFrame.bind(session);
    let [seen, now] = [null, performance.now()];
    session.requestAnimationFrame = callback => display(function draw(time, frame) {
      if (awaited > 0) return display(draw);
      if (time !== seen) [seen, now] = [time, now + 40];
      frames++;
      callback(now, frame);
    });
    return session;
  }

  // Pull the trigger and let go, over as many frames as it takes to be seen.
  kept.pull = async () => {
    let seen = false;
    kept.session.addEventListener('select', () => { seen = true; }, { once: true });
    for (let value = 1; !seen; value = 1 - value) {
      device.controllers.right.updateButtonValue('trigger', value);
      for (let i = 0; i < 2; i++) await drawn();
    }
    device.controllers.right.updateButtonValue('trigger', 0);
  };
  window.headset = kept;
})();
