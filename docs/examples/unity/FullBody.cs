using System;
using System.Collections.Generic;
using Unity.InferenceEngine;
using UnityEngine;

namespace Memmlp
{
    /// <summary>
    /// The network with its memory: one step for each frame at 60 Hz, from head and hands to a whole body.
    /// The asset is what `memmlp export RUN --scope full --space unity --opset 15 --out body.onnx` writes.
    /// Everything is in Unity's axes and metres. A tracker's rotation is the turn from the T-pose (facing +Z).
    /// </summary>
    public sealed class FullBody : IDisposable
    {
        public static readonly string[] Joints =
        {
            "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
            "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head",
            "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
        };

        /// <summary>The index of each joint's parent; a parent stands before its children.</summary>
        public static readonly int[] Parents =
        {
            -1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19,
        };

        /// <summary>Each joint's turn from the T-pose relative to its parent's; the root's is global.</summary>
        public readonly Quaternion[] Rotations = new Quaternion[Joints.Length];

        /// <summary>The joints, metres, by forward kinematics with the head on its tracker.</summary>
        public readonly Vector3[] Positions = new Vector3[Joints.Length];

        readonly Worker worker;
        readonly Dictionary<string, Tensor<float>> states = new Dictionary<string, Tensor<float>>();
        readonly Tensor<float> trackerPositions = new Tensor<float>(new TensorShape(1, 3, 3));
        readonly Tensor<float> trackerRotations = new Tensor<float>(new TensorShape(1, 3, 3, 3));
        readonly float[] places = new float[9], turns = new float[27];

        public FullBody(ModelAsset asset, BackendType backend = BackendType.CPU)
        {
            Model model = ModelLoader.Load(asset);
            foreach (Model.Input input in model.inputs)
                if (input.name.StartsWith("state."))
                    states.Add(input.name, new Tensor<float>(input.shape.ToTensorShape()));
            if (model.inputs.Count != states.Count + 2)
                throw new ArgumentException("not written by memmlp export with --scope full --space unity");
            worker = new Worker(model, backend);
        }

        /// <summary>Forget the past: a fresh start is zeros.</summary>
        public void Reset()
        {
            foreach (Tensor<float> state in states.Values)
                state.Upload(new float[state.shape.length]);
        }

        /// <summary>Take in head, left and right wrist of one frame. All must be known (see TrackedBody).</summary>
        public void Step(Pose[] trackers)
        {
            for (int k = 0; k < 3; k++)
            {
                Write(trackers[k].position, places, 3 * k, 1);
                Quaternion turn = trackers[k].rotation;
                Write(turn * Vector3.right, turns, 9 * k, 3); // the matrix' columns
                Write(turn * Vector3.up, turns, 9 * k + 1, 3);
                Write(turn * Vector3.forward, turns, 9 * k + 2, 3);
            }
            trackerPositions.Upload(places);
            trackerRotations.Upload(turns);
            worker.SetInput("tracker_positions", trackerPositions);
            worker.SetInput("tracker_rotations", trackerRotations);
            foreach (KeyValuePair<string, Tensor<float>> state in states)
                worker.SetInput(state.Key, state.Value);
            worker.Schedule();
            foreach (KeyValuePair<string, Tensor<float>> state in states)
            {
                Tensor tensor = state.Value;
                worker.CopyOutput(state.Key + ".next", ref tensor);
            }
            Read();
        }

        void Read()
        {
            float[] positions = ((Tensor<float>)worker.PeekOutput("positions")).DownloadToArray();
            float[] rotations = ((Tensor<float>)worker.PeekOutput("rotations")).DownloadToArray();
            bool quaternions = rotations.Length == 4 * Joints.Length; // of memmlp export --rotations quaternion
            for (int joint = 0; joint < Joints.Length; joint++)
            {
                Positions[joint] = Vector(positions, 3 * joint, 1);
                Rotations[joint] = quaternions ? Turn(rotations, 4 * joint) : Look(rotations, 9 * joint);
            }
        }

        static Quaternion Turn(float[] array, int start)
        {
            return new Quaternion(array[start], array[start + 1], array[start + 2], array[start + 3]);
        }

        /// <summary>Return the rotation of a matrix, whose columns are where right, up and forward go.</summary>
        static Quaternion Look(float[] array, int start)
        {
            return Quaternion.LookRotation(Vector(array, start + 2, 3), Vector(array, start + 1, 3));
        }

        static void Write(Vector3 vector, float[] array, int start, int stride)
        {
            for (int axis = 0; axis < 3; axis++)
                array[start + axis * stride] = vector[axis];
        }

        static Vector3 Vector(float[] array, int start, int stride)
        {
            return new Vector3(array[start], array[start + stride], array[start + 2 * stride]);
        }

        public void Dispose()
        {
            worker.Dispose();
            trackerPositions.Dispose();
            trackerRotations.Dispose();
            foreach (Tensor<float> state in states.Values)
                state.Dispose();
        }
    }
}
