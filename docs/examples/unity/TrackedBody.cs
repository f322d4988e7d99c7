using System;
using Unity.InferenceEngine;
using UnityEngine;
using UnityEngine.XR;

namespace Memmlp
{
    /// <summary>
    /// Drives an avatar from a headset and two controllers. Put it anywhere, and give it the network and an
    /// avatar that stands in a T-pose, facing its own +Z. Call Calibrate while the wearer stands in a T-pose.
    /// </summary>
    public class TrackedBody : MonoBehaviour
    {
        const double FrameTime = 1.0 / 60; // seconds; the network was trained at this rate
        const double Early = 5e-4; // seconds that a frame may be ahead of its sample
        const double Gap = 0.5; // seconds without a sample after which everything restarts
        const float Far = 0.25f; // metres; a device farther from a T-pose's joint is not attached there
        const float Recovery = 0.2f; // seconds over which a lost tracker comes back, as a jump looks like a blow

        static readonly XRNode[] Nodes = { XRNode.Head, XRNode.LeftHand, XRNode.RightHand };
        static readonly HumanBodyBones[] Humanoid = // in the order of FullBody.Joints
        {
            HumanBodyBones.Hips, HumanBodyBones.LeftUpperLeg, HumanBodyBones.RightUpperLeg, HumanBodyBones.Spine,
            HumanBodyBones.LeftLowerLeg, HumanBodyBones.RightLowerLeg, HumanBodyBones.Chest,
            HumanBodyBones.LeftFoot, HumanBodyBones.RightFoot, HumanBodyBones.UpperChest,
            HumanBodyBones.LeftToes, HumanBodyBones.RightToes, HumanBodyBones.Neck, HumanBodyBones.LeftShoulder,
            HumanBodyBones.RightShoulder, HumanBodyBones.Head, HumanBodyBones.LeftUpperArm,
            HumanBodyBones.RightUpperArm, HumanBodyBones.LeftLowerArm, HumanBodyBones.RightLowerArm,
            HumanBodyBones.LeftHand, HumanBodyBones.RightHand,
        };

        [Tooltip("What memmlp export --scope full --space unity --opset 15 wrote")]
        public ModelAsset network;

        [Tooltip("What the devices' poses are relative to: the XR Origin's floor")]
        public Transform trackingSpace;

        [Tooltip("The avatar's root")]
        public Transform avatar;

        [Tooltip("The avatar's bones in the order of FullBody.Joints; found by themselves for a Humanoid")]
        public Transform[] bones = new Transform[FullBody.Joints.Length];

        [Tooltip("Head, left and right wrist of the network's body in T-pose: `rest` of the file's metadata, " +
            "x negated. These are the built-in adult's.")]
        public Vector3[] rest =
        {
            new Vector3(0, 0.59f, 0.01f), new Vector3(-0.71f, 0.43f, -0.055f), new Vector3(0.71f, 0.43f, -0.055f),
        };

        FullBody body;
        readonly Quaternion[] tPose = new Quaternion[FullBody.Joints.Length];
        readonly Quaternion[] turns = new Quaternion[FullBody.Joints.Length];
        readonly Pose[] offsets = { Pose.identity, Pose.identity, Pose.identity }; // joint = device * offset
        readonly Pose[] devices = new Pose[3];
        readonly bool[] tracked = new bool[3];
        readonly float[] away = new float[3]; // seconds until a tracker is back at its true pose
        Pose[] last; // the trackers of the newest sample; null before the first
        double lastTime, nextFrame;

        void Start()
        {
            body = new FullBody(network);
            Animator animator = avatar.GetComponent<Animator>();
            if (animator != null && animator.isHuman)
            {
                for (int joint = 0; joint < bones.Length; joint++)
                    if (bones[joint] == null)
                        bones[joint] = animator.GetBoneTransform(Humanoid[joint]);
                animator.enabled = false; // it would pose the bones, too
            }
            for (int joint = 0; joint < bones.Length; joint++)
                if (bones[joint] != null)
                    tPose[joint] = Quaternion.Inverse(avatar.rotation) * bones[joint].rotation;
        }

        void OnDestroy()
        {
            body.Dispose();
        }

        void Update()
        {
            for (int k = 0; k < 3; k++)
            {
                InputDevice device = InputDevices.GetDeviceAtXRNode(Nodes[k]);
                tracked[k] = device.TryGetFeatureValue(CommonUsages.isTracked, out bool seen) && seen
                    && device.TryGetFeatureValue(CommonUsages.devicePosition, out devices[k].position)
                    && device.TryGetFeatureValue(CommonUsages.deviceRotation, out devices[k].rotation);
            }
            if (Sample(Time.unscaledTimeAsDouble))
                Show();
        }

        /// <summary>
        /// Learn where the joints are on the devices, from a wearer who stands upright in a T-pose. The line from
        /// hand to hand tells where the wearer looks. Return false, and keep what was known before, unless all three
        /// are tracked and near their joints in a T-pose, with the hands apart, and the head does not look backwards,
        /// as it does where the controllers are exchanged.
        /// </summary>
        public bool Calibrate()
        {
            Vector3 across = devices[2].position - devices[1].position;
            across.y = 0;
            if (!(tracked[0] && tracked[1] && tracked[2]) || across.magnitude < 0.1f)
                return false;
            Quaternion turn = Quaternion.LookRotation(Vector3.Cross(across, Vector3.up), Vector3.up);
            if (Vector3.Dot(devices[0].rotation * Vector3.forward, turn * Vector3.forward) < 0)
                return false;
            Vector3 place = Vector3.zero; // where the T-pose's origin is, so that the joints are near the devices
            for (int k = 0; k < 3; k++)
                place += (devices[k].position - turn * rest[k]) / 3;
            for (int k = 0; k < 3; k++)
                if ((place + turn * rest[k] - devices[k].position).magnitude > Far)
                    return false; // arms that hang would turn every later pose
            for (int k = 0; k < 3; k++)
            {
                Quaternion back = Quaternion.Inverse(devices[k].rotation);
                offsets[k] = new Pose(back * (place + turn * rest[k] - devices[k].position), back * turn);
            }
            last = null;
            return true;
        }

        /// <summary>Make the frames that are due at a time, and return whether there were any.</summary>
        bool Sample(double time)
        {
            if (last == null || Math.Abs(time - lastTime) > Gap)
            {
                if (!(tracked[0] && tracked[1] && tracked[2]))
                    return false; // nobody can be shown before all three were seen
                last = null;
                nextFrame = time;
                body.Reset();
            }
            else if (time <= lastTime)
                return false;
            Pose[] newest = Held((float)(time - lastTime));
            bool any = false;
            for (; nextFrame <= time + Early; nextFrame += FrameTime, any = true)
            {
                float weight = last == null ? 1 : (float)Math.Min(1.1, (nextFrame - lastTime) / (time - lastTime));
                body.Step(Between(last ?? newest, newest, weight));
            }
            last = newest;
            lastTime = time;
            return any;
        }

        /// <summary>
        /// Return the three joints, a lost one where it was as seen from the head. After its return it is led to
        /// its true pose.
        /// </summary>
        Pose[] Held(float seconds)
        {
            Pose[] made = new Pose[3];
            for (int k = 0; k < 3; k++)
            {
                Pose seen = new Pose(devices[k].position + devices[k].rotation * offsets[k].position,
                    devices[k].rotation * offsets[k].rotation);
                if (last == null)
                {
                    made[k] = seen;
                    away[k] = 0;
                    continue;
                }
                Pose kept = k == 0 ? last[0] : Carried(last[k], last[0], made[0]);
                if (!tracked[k])
                    away[k] = Recovery;
                bool back = away[k] <= seconds;
                made[k] = !tracked[k] ? kept : back ? seen : Lerp(kept, seen, seconds / away[k]);
                away[k] = Mathf.Max(0, tracked[k] ? away[k] - seconds : Recovery);
            }
            return made;
        }

        /// <summary>Return a hand that moves with the head and turns with where the head looks.</summary>
        static Pose Carried(Pose hand, Pose before, Pose now)
        {
            Quaternion turn = Heading(now.rotation) * Quaternion.Inverse(Heading(before.rotation));
            return new Pose(now.position + turn * (hand.position - before.position), turn * hand.rotation);
        }

        static Quaternion Heading(Quaternion rotation)
        {
            return new Quaternion(0, rotation.y, 0, rotation.w).normalized;
        }

        static Pose[] Between(Pose[] a, Pose[] b, float weight)
        {
            return new[] { Lerp(a[0], b[0], weight), Lerp(a[1], b[1], weight), Lerp(a[2], b[2], weight) };
        }

        static Pose Lerp(Pose a, Pose b, float weight)
        {
            return new Pose(Vector3.LerpUnclamped(a.position, b.position, weight),
                Quaternion.SlerpUnclamped(a.rotation, b.rotation, weight));
        }

        /// <summary>Pose the avatar: each bone is as in its T-pose, turned as the network turns the joint.</summary>
        void Show()
        {
            for (int joint = 0; joint < bones.Length; joint++)
            {
                int parent = FullBody.Parents[joint];
                turns[joint] = (parent < 0 ? trackingSpace.rotation : turns[parent]) * body.Rotations[joint];
                if (bones[joint] != null)
                    bones[joint].rotation = turns[joint] * tPose[joint];
            }
            bones[0].position = trackingSpace.TransformPoint(body.Positions[0]);
        }
    }
}
