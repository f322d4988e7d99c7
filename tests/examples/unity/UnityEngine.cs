// The few types of UnityEngine that the example uses, written from Unity's scripting reference for the tests.
// This is neither Unity nor a part of it.
using System;

namespace UnityEngine
{
    [AttributeUsage(AttributeTargets.Field)]
    public sealed class TooltipAttribute : Attribute
    {
        public TooltipAttribute(string tooltip) { }
    }

    public static class Mathf
    {
        public static float Max(float a, float b) { return Math.Max(a, b); }
    }

    public static class Time
    {
        public static double unscaledTimeAsDouble { get; set; }
    }

    public struct Vector3
    {
        public float x, y, z;

        public Vector3(float x, float y, float z) { this.x = x; this.y = y; this.z = z; }

        public static Vector3 zero { get { return new Vector3(0, 0, 0); } }
        public static Vector3 right { get { return new Vector3(1, 0, 0); } }
        public static Vector3 up { get { return new Vector3(0, 1, 0); } }
        public static Vector3 forward { get { return new Vector3(0, 0, 1); } }
        public float magnitude { get { return (float)Math.Sqrt(Dot(this, this)); } }
        public Vector3 normalized { get { return this / magnitude; } }
        public float this[int axis] { get { return axis == 0 ? x : axis == 1 ? y : z; } }

        public static float Dot(Vector3 a, Vector3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

        public static Vector3 Cross(Vector3 a, Vector3 b)
        {
            return new Vector3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
        }

        public static Vector3 LerpUnclamped(Vector3 a, Vector3 b, float t) { return a + (b - a) * t; }
        public static Vector3 operator +(Vector3 a, Vector3 b) { return new Vector3(a.x + b.x, a.y + b.y, a.z + b.z); }
        public static Vector3 operator -(Vector3 a, Vector3 b) { return new Vector3(a.x - b.x, a.y - b.y, a.z - b.z); }
        public static Vector3 operator *(Vector3 a, float s) { return new Vector3(a.x * s, a.y * s, a.z * s); }
        public static Vector3 operator /(Vector3 a, float s) { return a * (1 / s); }
    }

    public struct Quaternion
    {
        public float x, y, z, w;

        public Quaternion(float x, float y, float z, float w) { this.x = x; this.y = y; this.z = z; this.w = w; }

        public static Quaternion identity { get { return new Quaternion(0, 0, 0, 1); } }

        public Quaternion normalized
        {
            get
            {
                float n = (float)Math.Sqrt(x * x + y * y + z * z + w * w);
                return n == 0 ? identity : new Quaternion(x / n, y / n, z / n, w / n);
            }
        }

        public static Quaternion Inverse(Quaternion q) { return new Quaternion(-q.x, -q.y, -q.z, q.w); }

        public static Quaternion operator *(Quaternion a, Quaternion b)
        {
            return new Quaternion(
                a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
                a.w * b.y + a.y * b.w + a.z * b.x - a.x * b.z,
                a.w * b.z + a.z * b.w + a.x * b.y - a.y * b.x,
                a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z);
        }

        public static Vector3 operator *(Quaternion q, Vector3 v)
        {
            Quaternion turned = q * new Quaternion(v.x, v.y, v.z, 0) * Inverse(q);
            return new Vector3(turned.x, turned.y, turned.z);
        }

        public static Quaternion SlerpUnclamped(Quaternion a, Quaternion b, float t)
        {
            double cosine = a.x * b.x + a.y * b.y + a.z * b.z + a.w * b.w, sign = cosine < 0 ? -1 : 1;
            double angle = Math.Acos(Math.Min(1, Math.Abs(cosine))), sine = Math.Sin(angle);
            double p = sine < 1e-6 ? 1 - t : Math.Sin((1 - t) * angle) / sine;
            double q = sign * (sine < 1e-6 ? t : Math.Sin(t * angle) / sine);
            return new Quaternion((float)(p * a.x + q * b.x), (float)(p * a.y + q * b.y),
                (float)(p * a.z + q * b.z), (float)(p * a.w + q * b.w)).normalized;
        }

        // The rotation that carries +Z to `forward` and +Y as near to `up` as can be.
        public static Quaternion LookRotation(Vector3 forward, Vector3 up)
        {
            Vector3 c = forward.normalized, a = Vector3.Cross(up, c).normalized, b = Vector3.Cross(c, a);
            double[] squares =
            {
                1 + a.x - b.y - c.z, 1 - a.x + b.y - c.z, 1 - a.x - b.y + c.z, 1 + a.x + b.y + c.z,
            };
            int most = Array.IndexOf(squares, Math.Max(Math.Max(squares[0], squares[1]), Math.Max(squares[2], squares[3])));
            float yz = b.z + c.y, xz = c.x + a.z, xy = a.y + b.x, wx = b.z - c.y, wy = c.x - a.z, wz = a.y - b.x;
            float own = (float)squares[most];
            Quaternion q = most == 0 ? new Quaternion(own, xy, xz, wx) : most == 1 ? new Quaternion(xy, own, yz, wy)
                : most == 2 ? new Quaternion(xz, yz, own, wz) : new Quaternion(wx, wy, wz, own);
            return q.normalized;
        }
    }

    public struct Pose
    {
        public Vector3 position;
        public Quaternion rotation;

        public Pose(Vector3 position, Quaternion rotation) { this.position = position; this.rotation = rotation; }

        public static Pose identity { get { return new Pose(Vector3.zero, Quaternion.identity); } }
    }

    public class Object { }

    public class Component : Object { }

    public class MonoBehaviour : Component { }

    public class Transform : Component
    {
        public Transform parent;
        public Vector3 localPosition = Vector3.zero;
        public Quaternion localRotation = Quaternion.identity;
        public Component attached;

        public Quaternion rotation
        {
            get { return parent == null ? localRotation : parent.rotation * localRotation; }
            set { localRotation = parent == null ? value : Quaternion.Inverse(parent.rotation) * value; }
        }

        public Vector3 position
        {
            get { return parent == null ? localPosition : parent.TransformPoint(localPosition); }
            set
            {
                localPosition = parent == null
                    ? value : Quaternion.Inverse(parent.rotation) * (value - parent.position);
            }
        }

        public Vector3 TransformPoint(Vector3 point) { return position + rotation * point; }
        public T GetComponent<T>() where T : class { return attached as T; }
    }

    public enum HumanBodyBones
    {
        Hips, LeftUpperLeg, RightUpperLeg, LeftLowerLeg, RightLowerLeg, LeftFoot, RightFoot, Spine, Chest, Neck,
        Head, LeftShoulder, RightShoulder, LeftUpperArm, RightUpperArm, LeftLowerArm, RightLowerArm, LeftHand,
        RightHand, LeftToes, RightToes, UpperChest = 54,
    }

    public class Animator : Component
    {
        public bool isHuman = true, enabled = true;
        public Func<HumanBodyBones, Transform> find;

        public Transform GetBoneTransform(HumanBodyBones bone) { return find(bone); }
    }
}

namespace UnityEngine.XR
{
    public enum XRNode { LeftEye, RightEye, CenterEye, Head, LeftHand, RightHand }

    public struct InputFeatureUsage<T> { }

    public static class CommonUsages
    {
        public static InputFeatureUsage<bool> isTracked;
        public static InputFeatureUsage<Vector3> devicePosition;
        public static InputFeatureUsage<Quaternion> deviceRotation;
    }

    public struct InputDevice
    {
        public Pose? pose;

        public bool TryGetFeatureValue(InputFeatureUsage<bool> usage, out bool value)
        {
            value = pose.HasValue;
            return true;
        }

        public bool TryGetFeatureValue(InputFeatureUsage<Vector3> usage, out Vector3 value)
        {
            value = pose.GetValueOrDefault().position;
            return pose.HasValue;
        }

        public bool TryGetFeatureValue(InputFeatureUsage<Quaternion> usage, out Quaternion value)
        {
            value = pose.GetValueOrDefault().rotation;
            return pose.HasValue;
        }
    }

    public static class InputDevices
    {
        public static readonly Pose?[] Poses = new Pose?[6];

        public static InputDevice GetDeviceAtXRNode(XRNode node)
        {
            return new InputDevice { pose = Poses[(int)node] };
        }
    }
}
