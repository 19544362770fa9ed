#!/bin/bash
# A SLURM of one node on this machine, to try `--scheduler slurm` and the job scripts in `examples`. As root, on Debian:
#   apt-get install --no-install-recommends slurmctld slurmd slurm-client munge && benchmarks/one_node_slurm.sh
# It replaces /etc/slurm/slurm.conf.
set -e
mkdir -p /run/munge /var/log/munge /var/spool/slurmctld /var/spool/slurmd /var/log/slurm
chown munge: /run/munge /var/log/munge; chmod 755 /run/munge
chown slurm: /var/spool/slurmctld /var/log/slurm
cat > /etc/slurm/slurm.conf <<C
ClusterName=one
SlurmctldHost=$(hostname)
AuthType=auth/munge
SlurmUser=slurm
StateSaveLocation=/var/spool/slurmctld
SlurmdSpoolDir=/var/spool/slurmd
SlurmctldPidFile=/run/slurmctld.pid
SlurmdPidFile=/run/slurmd.pid
SlurmctldLogFile=/var/log/slurm/slurmctld.log
SlurmdLogFile=/var/log/slurm/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
ReturnToService=2
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SchedulerParameters=batch_sched_delay=1,sched_interval=5
NodeName=$(hostname) CPUs=$(nproc) RealMemory=$(free -m | awk '/^Mem/ {print int(0.6 * $2)}') State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
C
pgrep munged >/dev/null || runuser -u munge -- /usr/sbin/munged
pgrep slurmctld >/dev/null || slurmctld
pgrep -x slurmd >/dev/null || slurmd
sleep 4
sinfo; srun -n 2 hostname
