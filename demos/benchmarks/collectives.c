/* Counts the data that a process receives and sends by MPI, in all libraries; collectives.py compiles it and has it loaded before MPI. */
#include <mpi.h>

enum { CALLS, REDUCED, TOLD, ROWS, SENT, MESSAGES, KINDS };
/* Collective calls; bytes that reductions and broadcasts bring, that every rank sends to every other, of rows from others, of messages sent
   to single ranks; number of messages to single ranks, those of rows too. */
static long counts[KINDS];

long collectives(void) { return counts[CALLS]; }
void traffic(long *into) { for (int i = 0; i < KINDS; i++) into[i] = counts[i]; }

static long bytes(long n, MPI_Datatype t) { int s; PMPI_Type_size(t, &s); return n * s; }
static int size_of(MPI_Comm c) { int n; PMPI_Comm_size(c, &n); return n; }
static int rank_in(MPI_Comm c) { int r; PMPI_Comm_rank(c, &r); return r; }

/* Rows that come from others in the calls with a count for each, and the number of ranks to which this one sends any. */
static void rows(const int *sent, const int *got, MPI_Datatype t, int n, int own) {
    long heard = 0;
    for (int i = 0; i < n; i++)
        if (i != own) { heard += got[i]; counts[MESSAGES] += sent[i] > 0; }
    counts[ROWS] += bytes(heard, t);
}
static int sources(MPI_Comm c, int *destinations) { int in, weighted; PMPI_Dist_graph_neighbors_count(c, &in, destinations, &weighted); return in; }
static void neighbour_rows(const int *sent, const int *got, MPI_Datatype t, MPI_Comm c) {
    int out, in = sources(c, &out);
    long heard = 0;
    for (int i = 0; i < in; i++) heard += got[i];
    for (int i = 0; i < out; i++) counts[MESSAGES] += sent[i] > 0;
    counts[ROWS] += bytes(heard, t);
}

#define COUNT(result, name, declared, given, also) result name declared { counts[CALLS]++; also; return P##name given; }
#define TELL(n, t) counts[TOLD] += bytes(n, t) * (size_of(c) - 1)
#define REDUCE(n, t) if (size_of(c) > 1) counts[REDUCED] += bytes(n, t)
COUNT(int, MPI_Allreduce, (const void *a, void *b, int n, MPI_Datatype t, MPI_Op o, MPI_Comm c), (a, b, n, t, o, c), REDUCE(n, t))
COUNT(int, MPI_Reduce, (const void *a, void *b, int n, MPI_Datatype t, MPI_Op o, int r, MPI_Comm c), (a, b, n, t, o, r, c), REDUCE(n, t))
COUNT(int, MPI_Bcast, (void *a, int n, MPI_Datatype t, int r, MPI_Comm c), (a, n, t, r, c), REDUCE(n, t))
COUNT(int, MPI_Barrier, (MPI_Comm c), (c), )
COUNT(int, MPI_Scan, (const void *a, void *b, int n, MPI_Datatype t, MPI_Op o, MPI_Comm c), (a, b, n, t, o, c), REDUCE(n, t))
COUNT(int, MPI_Exscan, (const void *a, void *b, int n, MPI_Datatype t, MPI_Op o, MPI_Comm c), (a, b, n, t, o, c), REDUCE(n, t))
COUNT(int, MPI_Allgather, (const void *a, int n, MPI_Datatype t, void *b, int m, MPI_Datatype s, MPI_Comm c), (a, n, t, b, m, s, c), TELL(m, s))
COUNT(int, MPI_Allgatherv, (const void *a, int n, MPI_Datatype t, void *b, const int *m, const int *d, MPI_Datatype s, MPI_Comm c), (a, n, t, b, m, d, s, c),
      for (int i = 0; i < size_of(c); i++) if (i != rank_in(c)) counts[TOLD] += bytes(m[i], s))
COUNT(int, MPI_Alltoall, (const void *a, int n, MPI_Datatype t, void *b, int m, MPI_Datatype s, MPI_Comm c), (a, n, t, b, m, s, c), TELL(m, s))
COUNT(int, MPI_Alltoallv, (const void *a, const int *n, const int *e, MPI_Datatype t, void *b, const int *m, const int *d, MPI_Datatype s, MPI_Comm c), (a, n, e, t, b, m, d, s, c),
      rows(n, m, s, size_of(c), rank_in(c)))
COUNT(int, MPI_Reduce_scatter_block, (const void *a, void *b, int n, MPI_Datatype t, MPI_Op o, MPI_Comm c), (a, b, n, t, o, c), TELL(n, t))
COUNT(int, MPI_Neighbor_alltoall, (const void *a, int n, MPI_Datatype t, void *b, int m, MPI_Datatype s, MPI_Comm c), (a, n, t, b, m, s, c),
      int out; counts[ROWS] += sources(c, &out) * bytes(m, s); counts[MESSAGES] += out)
COUNT(int, MPI_Neighbor_alltoallv, (const void *a, const int *n, const int *e, MPI_Datatype t, void *b, const int *m, const int *d, MPI_Datatype s, MPI_Comm c), (a, n, e, t, b, m, d, s, c),
      neighbour_rows(n, m, s, c))
int MPI_Ineighbor_alltoallv(const void *a, const int *n, const int *e, MPI_Datatype t, void *b, const int *m, const int *d, MPI_Datatype s, MPI_Comm c, MPI_Request *r)
{ neighbour_rows(n, m, s, c); return PMPI_Ineighbor_alltoallv(a, n, e, t, b, m, d, s, c, r); }
COUNT(int, MPI_Gather, (const void *a, int n, MPI_Datatype t, void *b, int m, MPI_Datatype s, int r, MPI_Comm c), (a, n, t, b, m, s, r, c),
      if (rank_in(c) == r) TELL(m, s))
COUNT(int, MPI_Gatherv, (const void *a, int n, MPI_Datatype t, void *b, const int *m, const int *d, MPI_Datatype s, int r, MPI_Comm c), (a, n, t, b, m, d, s, r, c),
      if (rank_in(c) == r) for (int i = 0; i < size_of(c); i++) if (i != r) counts[TOLD] += bytes(m[i], s))
COUNT(int, MPI_Scatterv, (const void *a, const int *n, const int *d, MPI_Datatype t, void *b, int m, MPI_Datatype s, int r, MPI_Comm c), (a, n, d, t, b, m, s, r, c),
      if (rank_in(c) != r) counts[ROWS] += bytes(m, s))
COUNT(int, MPI_Comm_dup, (MPI_Comm c, MPI_Comm *d), (c, d), )
COUNT(int, MPI_Ibarrier, (MPI_Comm c, MPI_Request *r), (c, r), )

/* Messages to single ranks; of those that are made once and started often the bytes are kept by their request. */
#define KEPT 65536
static struct { MPI_Request request; long bytes; } kept[KEPT];
static unsigned place(MPI_Request r) {
    unsigned i = ((unsigned long)r >> 4) % KEPT;
    for (unsigned n = 0; kept[i].request && kept[i].request != r && n < KEPT; n++) i = (i + 1) % KEPT;
    return i;
}
static void started(MPI_Request r) { unsigned i = place(r); if (kept[i].request == r && kept[i].bytes >= 0) { counts[SENT] += kept[i].bytes; counts[MESSAGES]++; } }
static void made(MPI_Request r, long n) { unsigned i = place(r); kept[i].request = r; kept[i].bytes = n; }
#define SEND(name, more, also) int name(const void *a, int n, MPI_Datatype t, int to, int tag, MPI_Comm c more) \
    { if (to != rank_in(c) && to >= 0) { counts[SENT] += bytes(n, t); counts[MESSAGES]++; } return P##name(a, n, t, to, tag, c also); }
#define _ ,
SEND(MPI_Send, , )
SEND(MPI_Ssend, , )
SEND(MPI_Isend, _ MPI_Request *r, _ r)
SEND(MPI_Issend, _ MPI_Request *r, _ r)
int MPI_Send_init(const void *a, int n, MPI_Datatype t, int to, int tag, MPI_Comm c, MPI_Request *r)
{ int e = PMPI_Send_init(a, n, t, to, tag, c, r); made(*r, to == rank_in(c) ? -1 : bytes(n, t)); return e; }
int MPI_Recv_init(void *a, int n, MPI_Datatype t, int from, int tag, MPI_Comm c, MPI_Request *r)
{ int e = PMPI_Recv_init(a, n, t, from, tag, c, r); made(*r, -1); return e; }
int MPI_Start(MPI_Request *r) { started(*r); return PMPI_Start(r); }
int MPI_Startall(int n, MPI_Request r[]) { for (int i = 0; i < n; i++) started(r[i]); return PMPI_Startall(n, r); }
