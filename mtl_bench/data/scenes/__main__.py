"""A worker: renders every n-th scene and prints one JSON line for each."""

from mtl_bench.data.scenes.make import work

if __name__ == "__main__":
    work()
