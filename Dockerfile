# docker build --tag memmlp .                               CPU
# docker build --build-arg VARIANT=cuda --tag memmlp:cuda . NVIDIA GPUs; docker run --gpus all
ARG PYTHON=3.11
FROM python:${PYTHON}-slim AS base
ARG VARIANT=cpu
RUN apt-get update && apt-get install --yes --no-install-recommends build-essential git && rm -rf /var/lib/apt/lists/*
WORKDIR /memmlp
COPY constraints.txt .
# torch on its own: a change of the code does not download it again. PyPI's is the one with CUDA.
RUN if [ "$VARIANT" = cuda ]; then pip install --no-cache-dir -c constraints.txt torch==2.13.0; \
    else pip install --no-cache-dir -c constraints.txt torch==2.13.0 --index-url https://download.pytorch.org/whl/cpu; fi
COPY . .
RUN pip install --no-cache-dir -c constraints.txt '.[plots]'

FROM base
RUN useradd --create-home user
USER user
WORKDIR /home/user
CMD ["memmlp", "demo"]
