/* Counts the collective calls that a process makes of MPI, whoever makes them; collectives.py compiles it and has it loaded first. */
#include <mpi.h>

static long calls;

long collectives(void) { return calls; }

#define COUNT(result, name, declared, given) result name declared { calls++; return P##name given; }
COUNT(int, MPI_Allreduce, (const void *a, void *b, int n, MPI_Datatype t, MPI_Op o, MPI_Comm c), (a, b, n, t, o, c))
COUNT(int, MPI_Reduce, (const void *a, void *b, int n, MPI_Datatype t, MPI_Op o, int r, MPI_Comm c), (a, b, n, t, o, r, c))
COUNT(int, MPI_Bcast, (void *a, int n, MPI_Datatype t, int r, MPI_Comm c), (a, n, t, r, c))
COUNT(int, MPI_Barrier, (MPI_Comm c), (c))
COUNT(int, MPI_Scan, (const void *a, void *b, int n, MPI_Datatype t, MPI_Op o, MPI_Comm c), (a, b, n, t, o, c))
COUNT(int, MPI_Exscan, (const void *a, void *b, int n, MPI_Datatype t, MPI_Op o, MPI_Comm c), (a, b, n, t, o, c))
COUNT(int, MPI_Allgather, (const void *a, int n, MPI_Datatype t, void *b, int m, MPI_Datatype s, MPI_Comm c), (a, n, t, b, m, s, c))
COUNT(int, MPI_Allgatherv, (const void *a, int n, MPI_Datatype t, void *b, const int *m, const int *d, MPI_Datatype s, MPI_Comm c), (a, n, t, b, m, d, s, c))
COUNT(int, MPI_Alltoall, (const void *a, int n, MPI_Datatype t, void *b, int m, MPI_Datatype s, MPI_Comm c), (a, n, t, b, m, s, c))
COUNT(int, MPI_Alltoallv, (const void *a, const int *n, const int *e, MPI_Datatype t, void *b, const int *m, const int *d, MPI_Datatype s, MPI_Comm c), (a, n, e, t, b, m, d, s, c))
COUNT(int, MPI_Reduce_scatter_block, (const void *a, void *b, int n, MPI_Datatype t, MPI_Op o, MPI_Comm c), (a, b, n, t, o, c))
COUNT(int, MPI_Neighbor_alltoall, (const void *a, int n, MPI_Datatype t, void *b, int m, MPI_Datatype s, MPI_Comm c), (a, n, t, b, m, s, c))
COUNT(int, MPI_Neighbor_alltoallv, (const void *a, const int *n, const int *e, MPI_Datatype t, void *b, const int *m, const int *d, MPI_Datatype s, MPI_Comm c), (a, n, e, t, b, m, d, s, c))
COUNT(int, MPI_Gather, (const void *a, int n, MPI_Datatype t, void *b, int m, MPI_Datatype s, int r, MPI_Comm c), (a, n, t, b, m, s, r, c))
COUNT(int, MPI_Gatherv, (const void *a, int n, MPI_Datatype t, void *b, const int *m, const int *d, MPI_Datatype s, int r, MPI_Comm c), (a, n, t, b, m, d, s, r, c))
COUNT(int, MPI_Scatterv, (const void *a, const int *n, const int *d, MPI_Datatype t, void *b, int m, MPI_Datatype s, int r, MPI_Comm c), (a, n, d, t, b, m, s, r, c))
COUNT(int, MPI_Comm_dup, (MPI_Comm c, MPI_Comm *d), (c, d))
COUNT(int, MPI_Ibarrier, (MPI_Comm c, MPI_Request *r), (c, r))
