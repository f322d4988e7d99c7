// The few types of Unity.InferenceEngine that the example uses, as its documentation has them, for the tests.
// The network itself runs in the test's process: inputs are written to the standard output, and outputs are
// read from the standard input, both as floats in the order of the model.
using System;
using System.Collections.Generic;
using System.IO;
using System.Linq;

namespace Unity.InferenceEngine
{
    public enum BackendType { GPUCompute, CPU, GPUPixel }

    public struct TensorShape
    {
        readonly int[] dimensions;

        public TensorShape(params int[] dimensions) { this.dimensions = dimensions; }

        public int length { get { return dimensions.Aggregate(1, (a, b) => a * b); } }
    }

    public struct DynamicTensorShape
    {
        public int[] dimensions;

        public TensorShape ToTensorShape() { return new TensorShape(dimensions); }
    }

    public abstract class Tensor : IDisposable
    {
        public TensorShape shape;
        public float[] data;

        public void Dispose() { data = null; }
    }

    public class Tensor<T> : Tensor where T : struct
    {
        public Tensor(TensorShape shape) { this.shape = shape; data = new float[shape.length]; }

        public void Upload(float[] source) { Array.Copy(source, data, shape.length); }

        public float[] DownloadToArray() { return (float[])data.Clone(); }
    }

    public class Model
    {
        public struct Input { public string name; public DynamicTensorShape shape; }

        public List<Input> inputs = new List<Input>(), outputs = new List<Input>();
    }

    public class ModelAsset { public string[] inputs, outputs; } // each "name dimension dimension ..."

    public static class ModelLoader
    {
        public static Model Load(ModelAsset asset)
        {
            return new Model { inputs = asset.inputs.Select(Read).ToList(), outputs = asset.outputs.Select(Read).ToList() };
        }

        static Model.Input Read(string line)
        {
            string[] words = line.Split(' ');
            DynamicTensorShape shape = new DynamicTensorShape { dimensions = words.Skip(1).Select(int.Parse).ToArray() };
            return new Model.Input { name = words[0], shape = shape };
        }
    }

    public class Worker : IDisposable
    {
        readonly Model model;
        readonly Dictionary<string, Tensor> given = new Dictionary<string, Tensor>(), made = new Dictionary<string, Tensor>();
        readonly BinaryWriter writer = new BinaryWriter(Console.OpenStandardOutput());
        readonly BinaryReader reader = new BinaryReader(Console.OpenStandardInput());

        public Worker(Model model, BackendType backend)
        {
            this.model = model;
            foreach (Model.Input output in model.outputs)
                made[output.name] = new Tensor<float>(output.shape.ToTensorShape());
        }

        public void SetInput(string name, Tensor tensor)
        {
            if (!model.inputs.Any(input => input.name == name && input.shape.ToTensorShape().length == tensor.shape.length))
                throw new ArgumentException(name);
            given[name] = tensor;
        }

        public void Schedule()
        {
            foreach (Model.Input input in model.inputs)
                foreach (float value in given[input.name].data)
                    writer.Write(value);
            writer.Flush();
            foreach (Model.Input output in model.outputs)
                for (int index = 0; index < made[output.name].data.Length; index++)
                    made[output.name].data[index] = reader.ReadSingle();
        }

        public Tensor PeekOutput(string name) { return made[name]; }

        public void CopyOutput(string name, ref Tensor tensor) { Array.Copy(made[name].data, tensor.data, tensor.shape.length); }

        public void Dispose() { }
    }
}
