// Plays samples of trackers through TrackedBody as Unity would, and writes where the avatar's bones are and how they turned.
//
// play.exe model.txt avatar.csv samples.csv bones.csv: the model's inputs and outputs, a line each with an empty
// line between them; a row of 3 numbers for each bone, its place in T-pose; and rows of a time, 21 numbers and a
// word: "calibrate" asks for it after the sample, and "refuse" for one that has to fail. An empty place of a tracker is one that is lost.
using System;
using System.Globalization;
using System.IO;
using System.Linq;
using System.Reflection;
using System.Text;
using Memmlp;
using Unity.InferenceEngine;
using UnityEngine;
using UnityEngine.XR;

public static class Play
{
    static readonly XRNode[] Nodes = { XRNode.Head, XRNode.LeftHand, XRNode.RightHand };

    public static void Main(string[] words)
    {
        string[] model = File.ReadAllText(words[0]).Split(new[] { "\n\n" }, StringSplitOptions.None);
        TrackedBody tracked = new TrackedBody
        {
            network = new ModelAsset { inputs = Lines(model[0]), outputs = Lines(model[1]) },
            trackingSpace = new Transform(),
        };
        Transform[] rig = Rig(File.ReadAllLines(words[1]).Select(Numbers).ToArray());
        tracked.avatar = new Transform { attached = new Animator { find = bone => Find(rig, bone) } };
        Quaternion[] rest = rig.Select(bone => bone.rotation).ToArray();
        Call(tracked, "Start");
        StringBuilder bones = new StringBuilder();
        foreach (string line in File.ReadAllLines(words[2]))
        {
            string[] row = line.Split(',');
            Time.unscaledTimeAsDouble = Number(row[0]);
            for (int k = 0; k < 3; k++)
                InputDevices.Poses[(int)Nodes[k]] = Read(row.Skip(1 + 7 * k).Take(7).ToArray());
            Call(tracked, "Update");
            if (row[22] != "" && tracked.Calibrate() != (row[22] == "calibrate"))
                throw new InvalidOperationException(row[22] + " at " + row[0]);
            bones.AppendLine(string.Join(",", rig.Select((bone, joint) => Words(bone, rest[joint]))));
        }
        File.WriteAllText(words[3], bones.ToString());
    }

    // A rig whose bones have axes of their own, as those of an avatar have.
    static Transform[] Rig(float[][] places)
    {
        Transform[] bones = places.Select(place => new Transform()).ToArray();
        for (int joint = 0; joint < bones.Length; joint++)
        {
            int parent = FullBody.Parents[joint];
            bones[joint].parent = parent < 0 ? null : bones[parent];
            bones[joint].position = new Vector3(places[joint][0], places[joint][1], places[joint][2]);
            bones[joint].rotation = new Quaternion(0.1f * joint, 0.3f, -0.2f, 1).normalized;
        }
        return bones;
    }

    // The bone of a name: its joint is found by Unity's names, and not by the example's own table.
    static Transform Find(Transform[] rig, HumanBodyBones bone)
    {
        string[] names =
        {
            "Hips", "LeftUpperLeg", "RightUpperLeg", "Spine", "LeftLowerLeg", "RightLowerLeg", "Chest", "LeftFoot",
            "RightFoot", "UpperChest", "LeftToes", "RightToes", "Neck", "LeftShoulder", "RightShoulder", "Head",
            "LeftUpperArm", "RightUpperArm", "LeftLowerArm", "RightLowerArm", "LeftHand", "RightHand",
        };
        return rig[Array.IndexOf(names, bone.ToString())];
    }

    static void Call(object target, string name)
    {
        target.GetType().GetMethod(name, BindingFlags.Instance | BindingFlags.NonPublic).Invoke(target, null);
    }

    static Pose? Read(string[] row)
    {
        if (row[0] == "")
            return null;
        float[] n = row.Select(word => (float)Number(word)).ToArray();
        return new Pose(new Vector3(n[0], n[1], n[2]), new Quaternion(n[3], n[4], n[5], n[6]));
    }

    static string[] Lines(string text) { return text.Trim().Split('\n'); }
    static float[] Numbers(string line) { return line.Split(',').Select(word => (float)Number(word)).ToArray(); }
    static double Number(string word) { return double.Parse(word, CultureInfo.InvariantCulture); }

    // Where a bone is, and the quaternion by which it turned.
    static string Words(Transform bone, Quaternion rest)
    {
        Vector3 p = bone.position;
        Quaternion q = bone.rotation * Quaternion.Inverse(rest);
        float[] values = { p.x, p.y, p.z, q.x, q.y, q.z, q.w };
        return string.Join(",", values.Select(value => value.ToString("R", CultureInfo.InvariantCulture)));
    }
}
