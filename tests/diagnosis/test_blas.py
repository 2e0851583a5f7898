"""A diagnosis has threads of its own: linear algebra has one while it runs."""

import numpy as np
import threadpoolctl

from rig.diagnosis.numerics.blas import with_one_blas_thread


def blas_threads():
    return {
        item["num_threads"]
        for item in threadpoolctl.threadpool_info()
        if item["user_api"] == "blas"
    }


def test_linear_algebra_has_one_thread_while_a_function_runs_and_its_own_afterwards():
    np.eye(2) @ np.eye(2)
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        assert with_one_blas_thread(blas_threads)() == {1}
        assert blas_threads() == before
